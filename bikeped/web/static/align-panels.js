// The panels of the align page: the camera's values, the list of marks, the result of a fit.

import { $, el, fixed, setText } from "/static/ui.js";

export const NAMES = {
  height_m: ["Height", "m", 4],
  pitch_deg: ["Pitch", "°", 3],
  radius_px: ["Radius", "px", 2],
  cx: ["Centre, across", "px", 2],
  cy: ["Centre, down", "px", 2],
  heading_deg: ["Heading", "°", 3],
};
const HINTS = {
  height_m: "of the lens above the ground",
  pitch_deg: "0 looks level, negative looks down",
  radius_px: "of the lens circle, in pixels of the square crop",
  heading_deg: "turns the grid to the right of where the camera looks",
};
const FIRST = ["height_m", "pitch_deg", "radius_px"];

export const rounded = (key, value) => Number(value.toFixed(NAMES[key][2]));
const unitOf = (key) => (NAMES[key][1] === "°" ? "°" : ` ${NAMES[key][1]}`);

// Numbers with a true minus sign.
const minus = (text) => text.replace("-", "−");
export function sign(value, digits) {
  const size = Math.abs(value).toFixed(digits);
  return Number(size) === 0 ? size : `${value < 0 ? "−" : "+"}${size}`;
}

// A button with a sign on it, and its name for screen readers.
const signButton = (text, label, onclick) => el("button", { type: "button", "aria-label": label, onclick }, el("span", { "aria-hidden": "true" }, text));

// --- the camera's values: for each a number field, a slider, two buttons, and the effect at 10 m

export class Dials {
  // `changed()` is called after every change of `values`
  constructor(changed) {
    this.changed = changed;
    this.values = {};
    this.coarse = false;
    this.rows = new Map();
  }

  // Rows for the `fields` of /align/state, with their first values.
  make(fields, values) {
    for (const field of fields) this.row(field);
    this.setAll(values);
  }

  row(field) {
    const { key } = field;
    const [name, unit] = NAMES[key];
    const id = `dial-${key}`;
    const step = (way) => {
      const size = this.coarse ? field.coarse : field.step;
      this.set(key, Math.round(this.values[key] / size + way) * size);
    };
    const figure = el("input", {
      type: "number", id, step: "any", min: field.min, max: field.max, autocomplete: "off", "aria-describedby": `${id}-note`,
      oninput: () => { if (figure.value.trim() !== "" && figure.validity.valid) this.set(key, Number(figure.value), figure); },
      onchange: () => this.show(key),
      onkeydown: (event) => {
        const way = { ArrowUp: 1, ArrowDown: -1 }[event.key];
        if (!way) return;
        event.preventDefault();
        step(way);
      },
    });
    const slider = el("input", {
      type: "range", min: field.from, max: field.to, step: field.step, "aria-label": `${name}, slider`,
      oninput: () => this.set(key, Number(slider.value), slider),
    });
    const effect = el("span");
    const node = el("div", { class: "dial" },
      el("div", { class: "head" }, el("label", { for: id }, name), el("span", { class: "figure" }, figure, el("span", { class: "unit" }, unit))),
      signButton("−", `${name}: less`, () => step(-1)), slider, signButton("+", `${name}: more`, () => step(1)),
      el("p", { class: "note", id: `${id}-note` }, HINTS[key] ? `${HINTS[key]}. ` : "",
        ["height_m", "pitch_deg", "heading_deg"].includes(key) ? "" : `From ${field.origin}. `, effect));
    $(FIRST.includes(key) ? "#dials" : "#more-dials").append(node);
    this.rows.set(key, { field, figure, slider, effect });
  }

  show(key, but = null) {
    const { figure, slider } = this.rows.get(key);
    const value = this.values[key];
    for (const input of [figure, slider]) if (input !== but) input.value = value;
    slider.setAttribute("aria-valuetext", `${value}${unitOf(key)}`);
  }

  set(key, value, from = null) {
    const { field } = this.rows.get(key);
    const lowest = { height_m: 0.05, radius_px: 1 }[key] ?? field.min; // these must be above 0
    this.values[key] = rounded(key, Math.min(Math.max(value, lowest), field.max));
    this.show(key, from);
    this.changed();
  }

  setAll(values) {
    for (const [key, value] of Object.entries(values)) this.values[key] = rounded(key, value);
    for (const key of this.rows.keys()) this.show(key);
    this.changed();
  }

  setCoarse(coarse) {
    this.coarse = coarse;
    for (const [key, { field, slider }] of this.rows) {
      slider.step = coarse ? field.coarse : field.step;
      this.show(key);
    }
  }

  // The effect of one step of each value on a mark at 10 m; null: 10 m is not in view.
  showEffects(ten) {
    for (const [key, { effect }] of this.rows) {
      const moves = ten?.steps[key] ?? null;
      const what = Math.abs(moves) < 0.0005 ? "leaves a 10 m mark where it is" : `moves a 10 m mark by ${sign(100 * moves, 0)} cm`;
      setText(effect, moves === null ? "" : `${sign(ten.by[key], ten.by[key] < 1 ? 1 : 0)}${unitOf(key)} ${what}.`);
    }
  }
}

// --- the list of marks and of distances between them; a row's inputs stay while its texts change

// A field for a length in metres; `change` gets the number, or null where there is none.
function lengthInput(attributes, value, change) {
  const oninput = () => change(input.validity.valid && input.value.trim() !== "" ? Number(input.value) : null);
  const input = el("input", { type: "number", step: "any", max: 1000, value, ...attributes, oninput });
  return input;
}

export class MarkList {
  // `on`: changed(), chosen(mark, show), removed(mark), betweenChanged()
  constructor(on) {
    this.on = on;
    this.rows = new Map();
  }

  show(marks) {
    keepRows(this.rows, marks, (mark) => this.row(mark));
    for (const mark of marks) {
      const row = this.rows.get(mark.id);
      $(".no", row).setAttribute("aria-pressed", String(Boolean(mark.chosen)));
      setText($(".says", row), mark.says ?? "");
      $(".says", row).classList.toggle("off", Boolean(mark.off));
    }
    $("#no-marks").hidden = marks.length > 0;
    setText($("#marks-count"), marks.length ? `${marks.length}` : "");
    $("#export").disabled = $("#clear").disabled = marks.length === 0;
    $("#add-between").disabled = marks.length < 2;
  }

  row(mark) {
    const input = (name, label, attributes) => {
      const id = `${name}-${mark.id}`;
      const field = lengthInput({ id, autocomplete: "off", onfocus: () => this.on.chosen(mark), ...attributes }, mark[name], (metres) => {
        mark[name] = metres;
        this.on.changed();
      });
      return el("div", {}, el("label", { for: id }, label), field);
    };
    const row = el("li", {},
      el("button", { type: "button", class: "no", "aria-label": `Mark ${mark.name}, show it`, onclick: () => this.on.chosen(mark, true) }, mark.name),
      input("distance_m", "Distance, m", { min: 0.01, inputmode: "decimal" }), input("right_m", "To the right, m"),
      signButton("✕", `Delete mark ${mark.name}`, () => this.on.removed(mark)), el("span", { class: "says" }));
    $("#mark-list").append(row);
    return row;
  }

  focus(mark) {
    $(`#distance_m-${mark.id}`)?.focus();
  }

  // Rows of measured distances between two marks; `between` is changed in place.
  showBetween(between, marks) {
    const rows = between.map((pair, index) => {
      const choice = (key, label) => {
        const select = el("select", { "aria-label": label, onchange: () => {
          pair[key] = Number(select.value);
          this.on.betweenChanged();
        } }, marks.map((mark) => el("option", { value: mark.id, selected: mark.id === pair[key] }, mark.name)));
        return select;
      };
      const field = lengthInput({ min: 0.01, inputmode: "decimal", "aria-label": "Distance between them, m" }, pair.distance_m, (metres) => {
        pair.distance_m = metres;
        this.on.betweenChanged();
      });
      return el("li", {}, choice("first", "From mark"), choice("second", "To mark"), field, signButton("✕", "Delete this distance", () => {
        between.splice(index, 1);
        this.showBetween(between, marks);
        this.on.betweenChanged();
      }));
    });
    $("#between-list").replaceChildren(...rows);
  }
}

// Keeps an element for each of `items` in `rows`, by their ids; `make(item)` makes a missing one.
export function keepRows(rows, items, make) {
  for (const [id, row] of rows) {
    if (items.some((item) => item.id === id)) continue;
    row.remove();
    rows.delete(id);
  }
  for (const item of items) if (!rows.has(item.id)) rows.set(item.id, make(item));
}

// --- the result of a fit: values with their errors, warnings, and residuals

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
    el("th", { scope: "row" }, row.mark), el("td", {}, row.what === "spacing" ? "between" : row.what),
    el("td", { class: "number" }, minus(fixed(row.measured_m, 2))), el("td", { class: "number" }, minus(fixed(row.read_m, 2))),
    el("td", { class: "number" }, row.strange ? el("span", { class: "bad-mark" }, el("span", { class: "unseen" }, "outlier: ")) : null, sign(100 * row.off_m, 1))));
  const head = ["Mark", "What", "Tape, m", "Reads, m", "Off, cm"].map((text, i) => el("th", { scope: "col", class: i > 1 ? "number" : null }, text));
  parts.push(el("div", { class: "scroll" }, el("table", {}, el("caption", { class: "unseen" }, "Residuals"), el("thead", {}, el("tr", {}, head)), el("tbody", {}, rows))));
  return parts;
}
