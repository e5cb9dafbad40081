// The camera's values: for each a number field, a slider, two buttons, and the effect at 10 m.

import { FIRST, HINTS, NAMES, rounded, sign, unitOf } from "/static/align-words.js";
import { $, el, setText } from "/static/ui.js";

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
    for (const [key, value] of Object.entries(values)) this.values[key] = rounded(key, value);
    for (const field of fields) this.row(field);
    for (const key of this.rows.keys()) this.show(key);
  }

  row(field) {
    const [name, unit] = NAMES[field.key];
    const id = `dial-${field.key}`;
    const figure = el("input", { type: "number", id, step: "any", min: field.min, max: field.max, autocomplete: "off" });
    const slider = el("input", { type: "range", min: field.from, max: field.to, step: field.step, "aria-label": `${name}, slider` });
    const step = (way) => {
      const size = this.coarse ? field.coarse : field.step;
      this.set(field.key, Math.round(this.values[field.key] / size + way) * size);
    };
    figure.addEventListener("input", () => {
      if (figure.value.trim() !== "" && figure.validity.valid) this.set(field.key, Number(figure.value), figure);
    });
    figure.addEventListener("change", () => this.show(field.key));
    figure.addEventListener("keydown", (event) => {
      const way = { ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (!way) return;
      event.preventDefault();
      step(way);
    });
    slider.addEventListener("input", () => this.set(field.key, Number(slider.value), slider));
    const less = el("button", { type: "button", "aria-label": `${name}: less`, onclick: () => step(-1) }, el("span", { "aria-hidden": "true" }, "−"));
    const more = el("button", { type: "button", "aria-label": `${name}: more`, onclick: () => step(1) }, el("span", { "aria-hidden": "true" }, "+"));
    const effect = el("span", {});
    const about = el("p", { class: "note", id: `${id}-note` }, HINTS[field.key] ? `${HINTS[field.key]}. ` : "",
      FIRST.slice(0, 2).includes(field.key) || field.key === "heading_deg" ? "" : `From ${field.origin}. `, effect);
    figure.setAttribute("aria-describedby", about.id);
    const node = el("div", { class: "dial" },
      el("div", { class: "head" }, el("label", { for: id }, name), el("span", { class: "figure" }, figure, el("span", { class: "unit" }, unit))),
      less, slider, more, about);
    $(FIRST.includes(field.key) ? "#dials" : "#more-dials").append(node);
    this.rows.set(field.key, { field, figure, slider, effect });
  }

  show(key, but = null) {
    const { figure, slider } = this.rows.get(key);
    const value = this.values[key];
    if (figure !== but) figure.value = value;
    if (slider !== but) slider.value = value;
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
      const moves = ten && ten.steps[key];
      const known = typeof moves === "number";
      const flat = known && Math.abs(moves) < 0.0005;
      setText(effect, known
        ? `${sign(ten.by[key], ten.by[key] < 1 ? 1 : 0)}${unitOf(key)} ${flat ? "leaves a 10 m mark where it is" : `moves a 10 m mark by ${sign(100 * moves, 0)} cm`}.`
        : "");
    }
  }
}
