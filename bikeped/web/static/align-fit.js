// The result of a fit: values with their errors, warnings, and residuals.

import { NAMES, minus, sign, unitOf } from "/static/align-words.js";
import { el, fixed } from "/static/ui.js";

// Elements for an answer of /align/fit; `next` are its values, rounded.
export function fitAnswer(answer, next) {
  const found = Object.entries(answer.error).map(([key, error]) => {
    const digits = unitOf(key) === " px" ? 1 : 2;
    return `${NAMES[key][0]} ${minus(fixed(next[key], digits))} ± ${fixed(error, digits)}${unitOf(key)}`;
  });
  const parts = [el("p", { class: "verdict" }, `${found.join(", ")}.`)];
  if (answer.at_10m_error_m !== null) parts.push(el("p", {}, `What reads 10 m is 10 m ± ${fixed(100 * answer.at_10m_error_m, 0)} cm.`));
  if (answer.spare_measurements === 0) parts.push(el("p", { class: "warn" }, "No measurement is left to check these values. Add a mark."));
  if (answer.suspect) parts.push(el("p", { class: "warn" }, `Without mark ${answer.suspect} the others agree: set and measure it again.`));
  else if (!answer.agrees) parts.push(el("p", { class: "warn" }, "The marks do not agree with one another: set and measure them again."));
  const rows = answer.residuals.map((row) => el("tr", {},
    el("th", { scope: "row" }, row.mark), el("td", {}, { distance: "distance", right: "right", forward: "forward", spacing: "between" }[row.what]),
    el("td", { class: "number" }, minus(fixed(row.measured_m, 2))), el("td", { class: "number" }, minus(fixed(row.read_m, 2))),
    el("td", { class: "number" }, row.strange ? el("span", { class: "bad-mark" }, el("span", { class: "unseen" }, "outlier: ")) : null, sign(100 * row.off_m, 1))));
  const head = ["Mark", "What", "Tape, m", "Reads, m", "Off, cm"].map((text, i) => el("th", { scope: "col", class: i > 1 ? "number" : null }, text));
  parts.push(el("div", { class: "scroll" }, el("table", {}, el("caption", { class: "unseen" }, "Residuals"), el("thead", {}, el("tr", {}, head)), el("tbody", {}, rows))));
  return parts;
}
