// Editing scenarios: waypoints on the plan, and the same as a table for the keyboard.

import { announce, el, setText } from "/static/ui.js";

const KINDS = ["pedestrian", "cyclist", "car", "motorcycle", "bus", "truck"];
const ROLE = { pedestrian: "pedestrian", cyclist: "cyclist", motorcycle: "cyclist" };
const HAZARDS = ["safe", "standard", "high-speed", "accessibility", "multi-agent", "edge", "non-linear"];
const LEAST_STEP_S = 0.05;

const round = (value, digits) => Math.round(value * 10 ** digits) / 10 ** digits;

// `change(script)` at every edit; `actions` = {save(), load(file), original(), add()}. Returns
// {show(script, own), handles(), drag}.
export function editor(host, change, actions) {
  let script = null, chosen = [0, 0], built = "", keepSpeed = true, nameField = null;
  const rows = [];

  // The page may rename the changed scenario.
  const emit = () => { script.name = change(structuredClone(script)); };
  const edited = () => { sync(); emit(); };
  const handles = () => (script?.agents ?? []).flatMap((agent, a) => agent.path.map(([t, x, y], i) => (
    { a, i, t, x, y, role: ROLE[agent.kind] ?? "vehicle", chosen: chosen[0] === a && chosen[1] === i })));

  const drag = {
    pick(x, y, reach) {
      let best = null, least = reach;
      for (const handle of handles()) {
        const far = Math.hypot(handle.x - x, handle.y - y);
        if (far < least) { best = handle; least = far; }
      }
      if (best) chosen = [best.a, best.i];
      return best;
    },
    move({ a, i }, x, y) {
      place(script.agents[a].path, i, round(x, 2), round(y, 2), keepSpeed);
      edited();
    },
    drop() { announce("Path changed."); },
    add(x, y) {
      const path = script.agents[chosen[0]].path;
      const [t, px, py] = path[path.length - 1];
      const pace = speedOf(path, path.length - 1) || 1.4;
      path.push([round(t + Math.max(Math.hypot(x - px, y - py) / pace, LEAST_STEP_S), 2), round(x, 2), round(y, 2)]);
      chosen = [chosen[0], path.length - 1];
      edited();
    },
  };

  function sync() {
    const key = JSON.stringify(script.agents.map((agent) => [agent.id, agent.kind, agent.path.length]));
    if (key !== built) { build(); built = key; }
    if (document.activeElement !== nameField) nameField.value = script.name;
    for (const { a, i, fields } of rows) {
      const path = script.agents[a].path;
      const values = [...path[i], i ? speedOf(path, i) : null];
      fields.forEach((field, k) => { if (field && document.activeElement !== field) field.value = values[k] === null ? "" : round(values[k], 2); });
    }
  }

  function build() {
    rows.length = 0;
    const rename = () => { if (nameField.value.trim()) { script.name = nameField.value.trim(); emit(); } };
    nameField = el("input", { type: "text", value: script.name, maxlength: 120, "aria-label": "Name of the scenario", onchange: rename });
    const pick = (label, values, key) => {
      const onchange = (event) => { script[key] = event.target.value; emit(); };
      return el("label", { class: "tb-pick" }, el("span", {}, label),
        el("select", { "aria-label": label, onchange }, values.map((value) => el("option", { value, selected: script[key] === value }, value))));
    };
    const keep = el("input", { type: "checkbox", checked: keepSpeed, id: "ed-keep", onchange: () => { keepSpeed = keep.checked; } });
    const open = () => { if (file.files[0]) actions.load(file.files[0]); file.value = ""; };
    const file = el("input", { type: "file", class: "unseen", accept: ".yaml,.yml,text/yaml", id: "ed-open", onchange: open });
    host.replaceChildren(
      el("p", { class: "note" }, "Drag the squares in the plan; a double click adds a waypoint to the road user last touched. Or write the numbers: t in seconds, x east and y north in metres; the speed is that on the way to this waypoint."),
      el("div", { class: "ed-top" },
        el("label", { class: "tb-pick ed-name" }, el("span", {}, "Name"), nameField),
        pick("Hazard", HAZARDS, "hazard"), pick("Vehicle", ["bicycle", "ebike"], "vehicle"), pick("Expected", ["idle", "safe", "warning", "alert"], "expected"),
        el("label", { class: "row ed-keep" }, keep, "moving keeps speeds (else times)")),
      el("div", { class: "ed-agents" }, script.agents.map(agentTable)),
      el("div", { class: "row" },
        ["pedestrian", "cyclist", "car"].map((kind) => el("button", { type: "button", class: "small", onclick: () => addAgent(kind) }, `Add a ${kind}`)),
        el("button", { type: "button", class: "small primary", onclick: actions.save }, "Save as a scenario file"),
        el("label", { class: "button small", for: "ed-open" }, "Open a scenario file", file),
        el("button", { type: "button", class: "small", onclick: actions.original }, "Throw my paths away")),
      el("p", { class: "error", id: "ed-error", role: "alert" }));
  }

  function agentTable(agent, a) {
    const kind = el("select", { "aria-label": `Kind of road user ${agent.id}` }, KINDS.map((k) => el("option", { value: k, selected: agent.kind === k }, k)));
    kind.addEventListener("change", () => { agent = script.agents[a]; agent.kind = kind.value; delete agent.size; edited(); });
    const body = el("tbody", {}, agent.path.map((point, i) => pointRow(agent.id, a, i)));
    return el("fieldset", { class: "ed-agent", "data-role": ROLE[agent.kind] ?? "vehicle" },
      el("legend", {}, `${agent.kind} ${agent.id}`),
      el("div", { class: "row" }, kind, el("button", { type: "button", class: "small", onclick: () => removeAgent(a), disabled: script.agents.length < 2, "aria-label": `Remove ${agent.kind} ${agent.id}` }, "Remove")),
      el("table", {},
        el("thead", {}, el("tr", {}, ["t, s", "x, m", "y, m", "m/s", ""].map((text) => el("th", { scope: "col" }, text || el("span", { class: "unseen" }, "Do"))))), body));
  }

  function pointRow(id, a, i) {
    const field = (label, k) => {
      const input = el("input", { type: "number", step: "any", "aria-label": `${label} of waypoint ${i + 1}, road user ${id}` });
      input.addEventListener("focus", () => { chosen = [a, i]; actions.touched(); });
      input.addEventListener("input", () => {
        const value = Number(input.value);
        if (input.value === "" || !Number.isFinite(value)) return;
        edit(script.agents[a].path, i, k, value, keepSpeed);
        edited();
      });
      return input;
    };
    const fields = [field("Time", 0), field("East", 1), field("North", 2), i ? field("Speed", 3) : null];
    rows.push({ a, i, fields });
    return el("tr", {}, fields.map((input) => el("td", {}, input)), el("td", { class: "ed-do" },
      el("button", { type: "button", class: "small ed-mini", "aria-label": `Add a waypoint after ${i + 1}, road user ${id}`, onclick: () => addPoint(a, i) }, "+"),
      el("button", { type: "button", class: "small ed-mini", disabled: script.agents[a].path.length < 3, "aria-label": `Remove waypoint ${i + 1}, road user ${id}`, onclick: () => removePoint(a, i) }, "−")));
  }

  function addPoint(a, i) {
    const path = script.agents[a].path, here = path[i], next = path[i + 1];
    const point = next ? here.map((value, k) => round((value + next[k]) / 2, 2)) : [round(here[0] + 1, 2), round(2 * here[1] - path[i - 1][1], 2), round(2 * here[2] - path[i - 1][2], 2)];
    path.splice(i + 1, 0, point);
    edited();
  }

  function removePoint(a, i) {
    script.agents[a].path.splice(i, 1);
    chosen = [a, 0];
    edited();
  }

  function removeAgent(a) {
    script.agents.splice(a, 1);
    chosen = [0, 0];
    edited();
  }

  function addAgent(kind) {
    const id = Math.max(0, ...script.agents.map((agent) => agent.id)) + 1;
    const path = kind === "pedestrian" ? [[0, 5, -7], [10, 5, 6]] : [[1, -14, round(-2 + id % 4, 1)], [8, 22, round(-2 + id % 4, 1)]];
    script.agents.push({ id, kind, path });
    chosen = [script.agents.length - 1, 0];
    edited();
  }

  return {
    drag, handles,
    show(next) {
      script = structuredClone(next);
      sync();
    },
    fail(text) { const place = host.querySelector("#ed-error"); if (place) setText(place, text); },
    rebuild() { built = ""; },
  };
}

// Speed on the way to waypoint i.
function speedOf(path, i) {
  const [t0, x0, y0] = path[i - 1], [t1, x1, y1] = path[i];
  return Math.hypot(x1 - x0, y1 - y0) / Math.max(t1 - t0, 1e-9);
}

// One number of a waypoint: 0 time, 1 east, 2 north, 3 speed. Later times follow.
function edit(path, i, what, value, keepSpeed) {
  if (what === 1 || what === 2) place(path, i, what === 1 ? value : path[i][1], what === 2 ? value : path[i][2], keepSpeed);
  else if (what === 3) {
    if (value <= 0) return;
    const way = Math.hypot(path[i][1] - path[i - 1][1], path[i][2] - path[i - 1][2]);
    if (way > 0) shift(path, i, path[i - 1][0] + Math.max(way / value, LEAST_STEP_S) - path[i][0]);
  } else {
    const least = i ? path[i - 1][0] + LEAST_STEP_S : 0;
    shift(path, i, Math.max(value, least) - path[i][0]);
  }
}

// Moves a waypoint; with `keepSpeed` the times before and after it follow its new ways.
function place(path, i, x, y, keepSpeed) {
  const before = i ? speedOf(path, i) : 0, after = i + 1 < path.length ? speedOf(path, i + 1) : 0;
  path[i][1] = x;
  path[i][2] = y;
  if (!keepSpeed) return;
  if (before > 0.01) shift(path, i, path[i - 1][0] + Math.max(Math.hypot(x - path[i - 1][1], y - path[i - 1][2]) / before, LEAST_STEP_S) - path[i][0]);
  if (after > 0.01) shift(path, i + 1, path[i][0] + Math.max(Math.hypot(path[i + 1][1] - x, path[i + 1][2] - y) / after, LEAST_STEP_S) - path[i + 1][0]);
}

function shift(path, from, by) {
  for (let i = from; i < path.length; i++) path[i][0] = round(path[i][0] + by, 3);
}
