// The whole suite, before and after: gates, figures, a strip for every scenario, and how to repeat it.

import { canvasOf, el, fixed, percent, seconds } from "/static/ui.js";
import { drawStrip, stripWords } from "/static/testbench-timeline.js";

const FIGURES = [
  ["sensitivity", "Sensitivity", percent, 1], ["specificity", "Specificity", percent, 1],
  ["mean_warning_budget_s", "Mean warning budget", (v) => seconds(v, 2), 1],
  ["contact_sensitivity", "Contact sensitivity", percent, 1], ["sev_fn", "Missed severity (SevFN)", percent, -1],
  ["fatigue", "Fatigue (share of time red)", percent, -1], ["mean_alert_latency_s", "Mean alert latency", (v) => seconds(v, 2), -1],
  ["false_episodes_per_hour", "False episodes an hour", (v) => fixed(v, 1), -1],
];

// `actions` = {open(name), save(), link()}
export function suitePanel(host, actions) {
  return (data, trials) => {
    const changed = data.changes.length > 0;
    host.replaceChildren(
      el("div", { class: "su-top" }, gates(data, changed), figures(data, changed, trials), repeat(data, changed, actions)),
      strips(data, changed, actions),
    );
  };
}

function verdict(side) {
  const failed = side.gates.filter((gate) => !gate.holds).map((gate) => gate.name.toLowerCase());
  return failed.length ? `fails: ${failed.join(", ")}` : "holds all gates";
}

function gates(data, changed) {
  const { before, after } = data;
  const row = (gate, i) => el("tr", {},
    el("th", { scope: "row" }, gate.name), el("td", { class: "number" }, gate.rule),
    changed ? el("td", { class: "number" }, mark(before.gates[i])) : null,
    el("td", { class: "number" }, mark(gate)));
  return el("div", { class: "su-gates scroll", tabindex: 0, role: "region", "aria-label": "Gates" },
    el("p", { class: "su-verdict", "data-holds": after.promotable }, changed ? `With your changes the configuration ${verdict(after)}.` : `The configuration in force ${verdict(after)}.`),
    changed ? el("p", { class: "note" }, `Before, it ${before.promotable ? "held all gates" : `failed: ${before.gates.filter((g) => !g.holds).map((g) => g.name.toLowerCase()).join(", ")}`}.`) : null,
    el("table", {},
      el("caption", {}, `Deployment gates over ${after.scenarios} scenarios`),
      el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Gate"), el("th", { scope: "col", class: "number" }, "required"), changed ? el("th", { scope: "col", class: "number" }, "before") : null, el("th", { scope: "col", class: "number" }, changed ? "after" : "measured"))),
      el("tbody", {}, after.gates.map(row))));
}

const mark = (gate) => el("span", { class: gate.holds ? "ok-mark" : "bad-mark" }, gate.shown, el("span", { class: "unseen" }, gate.holds ? " holds" : " fails"));

function figures(data, changed, trials) {
  const cell = (side, key, say) => say(side.totals[key]);
  const head = ["Figure", ...(changed ? ["before", "after", "change"] : ["measured"]), ...(trials ? [`mean of ${trials.trials} trials`] : [])];
  return el("div", { class: "su-figures scroll", tabindex: 0, role: "region", "aria-label": "Figures of the suite" }, el("table", {},
    el("caption", {}, "Figures over all frames of the suite"),
    el("thead", {}, el("tr", {}, head.map((text, i) => el("th", { scope: "col", class: i ? "number" : "" }, text)))),
    el("tbody", {}, FIGURES.map(([key, name, say, better]) => {
      const a = data.before.totals[key], b = data.after.totals[key];
      const difference = a === null || b === null ? null : b - a;
      const worse = difference !== null && Math.abs(difference) > 5e-4 && Math.sign(difference) !== better;
      const unit = say === percent ? `${(100 * difference).toFixed(1)}\u00a0pp` : difference?.toFixed(2);
      const small = difference === null || Math.abs(difference) < 5e-4;
      const mean = trials?.[key];
      return el("tr", {}, el("th", { scope: "row" }, name),
        changed ? el("td", { class: "number" }, cell(data.before, key, say)) : null,
        el("td", { class: "number" }, cell(data.after, key, say)),
        changed ? el("td", { class: `number ${small ? "" : worse ? "bad-mark" : "ok-mark"}` }, small ? "–" : `${difference > 0 ? "+" : "−"}${unit.replace("-", "")}`) : null,
        trials ? el("td", { class: "number" }, mean.mean === null ? "–" : mean.low === null ? say(mean.mean) : `${say(mean.mean)} (${say(mean.low)} to ${say(mean.high)})`) : null);
    }))));
}

function repeat(data, changed, actions) {
  const list = data.changes.map(({ key, before, after }) => el("li", {}, el("code", {}, key.replace("danger.", "truth.")), ` ${word(before)} → `, el("b", {}, word(after))));
  return el("div", { class: "su-repeat" },
    el("h3", {}, changed ? "Your changes" : "Nothing is changed yet"),
    changed ? el("ul", { class: "su-changes" }, list) : el("p", { class: "note" }, "Move a slider or edit a path: the suite runs again, and the changes are listed here."),
    changed ? el("div", { class: "row" },
      el("button", { type: "button", class: "small primary", onclick: actions.save }, "Save as a file"),
      el("button", { type: "button", class: "small", onclick: actions.link }, "Copy link")) : null,
    el("label", { class: "button small" }, "Open a file", el("input", { type: "file", class: "unseen", id: "open-challenge", accept: ".json,application/json", onchange: actions.load })),
    changed ? el("div", {}, el("p", { class: "note" }, "Commands that compute the same numbers:"),
      el("pre", { tabindex: 0, "aria-label": "Command line" }, `${data.again}${data.command ? `\n${data.command}` : ""}`)) : null);
}

function word(value) {
  if (value === null) return "none";
  if (typeof value === "object") return Object.values(value).map((v) => Math.round(v * 100) / 100).join(", ");
  return typeof value === "number" ? String(Math.round(value * 1e6) / 1e6) : String(value);
}

function strips(data, changed, actions) {
  const different = new Map(data.changed.map((entry) => [entry.scenario, entry]));
  const rows = data.strips.map((strip) => {
    const entry = different.get(strip.name);
    const after = data.after.by_scenario[strip.name], before = data.before.by_scenario[strip.name];
    const canvas = el("canvas", { class: "su-strip", role: "img", "aria-label": stripWords(strip, entry) });
    const values = (key, say) => {
      const now = say(after[key]), then = before ? say(before[key]) : "–";
      return changed && now !== then ? [el("s", { class: "su-was" }, then), " ", el("b", {}, now)] : now;
    };
    const row = el("tr", { class: entry ? "differs" : "" },
      el("th", { scope: "row" }, el("button", { type: "button", class: "su-open", onclick: () => actions.open(strip.name) }, strip.name), entry ? el("span", { class: "su-note" }, entry.frames_state === undefined ? entry.what : `${entry.frames_state} frames differ`) : null),
      el("td", { class: "su-cell" }, canvas),
      el("td", { class: "number" }, values("sensitivity", (v) => percent(v, 0))),
      el("td", { class: "number" }, values("specificity", (v) => percent(v, 0))),
      el("td", { class: "number" }, values("min_warning_budget_s", (v) => seconds(v, 2))));
    canvasOf(canvas, (context, width, height) => drawStrip(context, width, height, strip, changed));
    return row;
  });
  const order = changed ? [...rows].sort((a, b) => b.classList.contains("differs") - a.classList.contains("differs")) : rows;
  return el("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Every scenario" }, el("table", { class: "su-table" },
    el("caption", {}, changed ? `${different.size} of ${data.strips.length} scenarios change. Each strip: danger above, states below, before (pale) over after.` : "Each strip: danger above, states below; the higher, the more urgent."),
    el("thead", {}, el("tr", {}, ["Scenario", "Over time", "Sensitivity", "Specificity", "Shortest budget"].map((text, i) => el("th", { scope: "col", class: i > 1 ? "number" : "" }, text)))),
    el("tbody", {}, order)));
}
