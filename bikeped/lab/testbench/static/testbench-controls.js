// The settings of the bench, each with a slider and a number field. Ranges and descriptions come from
// the Python types that check them.

import { el, setText } from "/static/ui.js";

const CHOICES = {
  "decision.rule": [["pairwise", "pairwise (the paper’s)"], ["naive", "naive closing"], ["ttc", "time to collision"], ["distance", "distance only"]],
  "perception.recall": [["all", "all are detected"], ["size", "measured, by size"], ["kind", "measured, by kind"], ["fixed", "a fixed share"]],
  "delay.order": [[0, "none"], [1, "by velocity"], [2, "and acceleration"]],
  "danger.braking": [[null, "by the scenario"], ["bicycle", "bicycle"], ["ebike", "e-bike"], ["aashto", "AASHTO"]],
};

// [group, open, settings]; a setting is [key, label, unit, slider's low, high, step], or a kind.
const GROUPS = [
  ["The rule", true, [
    ["decision.rule", "closing check", "choice"],
    ["decision.memory_frames", "memory N", "frames", 0, 120, 1],
    ["decision.d_min_m", "nearest d_min", "m", 0.5, 5, 0.1],
    ["decision.d_max_m", "farthest d_max", "m", 5, 25, 0.1],
    ["decision.min_displacement_m", "displacement δ_min", "m", 0, 0.5, 0.001],
    ["decision.lookback_frames", "lookback k", "frames", 1, 10, 1],
    ["decision.speed_adaptive", "d_max grows with speed", "switch"],
    ["decision.ttc_s", "bound (rule time to collision)", "s", 0.5, 8, 0.1],
  ]],
  ["Perception", false, [
    ["perception.localisation_error", "position error", "switch"],
    ["perception.recall", "detection", "choice"],
    ["perception.recall_value", "share detected", "", 0.3, 1, 0.01],
    ["perception.burst_frames", "misses in runs of", "frames", 1, 30, 1, 5],
    ["perception.trial", "random trial", "", 0, 49, 1],
    ["perception.seed", "seed", "number"],
    ["perception.trials", "trials for means", "", 1, 50, 1],
  ]],
  ["Delay", false, [
    ["delay.delay_ms", "age of the picture", "ms", 0, 500, 33],
    ["delay.order", "prediction", "choice"],
  ]],
  ["The camera’s mount", false, [
    ["camera.height_m", "height", "m", 1.5, 9, 0.1],
    ["camera.pitch_deg", "pitch", "°", -90, 10, 1],
    ["camera.fov_deg", "field of view", "°", 60, 220, 0.1],
    ["camera.x_m", "east", "m", -20, 30, 0.5],
    ["camera.y_m", "north", "m", -30, 30, 0.5],
    ["camera.heading_deg", "heading", "°", -180, 360, 5],
    ["second_camera", "a second camera", "second"],
    ["second_camera.x_m", "second: east", "m", -20, 30, 0.5],
    ["second_camera.y_m", "second: north", "m", -30, 30, 0.5],
    ["second_camera.heading_deg", "second: heading", "°", -180, 360, 5],
  ]],
  ["What counts as danger", false, [
    ["danger.cpa_radius_m", "closest approach below", "m", 0.5, 15, 0.1],
    ["danger.stopping_margin", "stopping distance over gap", "", 0.1, 2, 0.05],
    ["danger.ttc_bound_s", "contact within", "s", 0.5, 10, 0.1, 3],
    ["danger.braking", "all cyclists brake as", "choice"],
  ]],
];

const OPPOSITE = { x_m: 5, y_m: 13, heading_deg: 270 };

const get = (bench, key) => key.split(".").reduce((place, name) => place?.[name], bench);

// A bench with one setting changed.
export function set(bench, key, value) {
  const [section, name] = key.split(".");
  return name ? { ...bench, [section]: { ...bench[section], [name]: value } } : { ...bench, [section]: value };
}

// Builds the controls in `host`; `change(key, value)` at every change. Returns show(bench, base).
export function controls(host, about, change) {
  const shown = [];
  for (const [title, open, settings] of GROUPS) {
    const mark = el("span", { class: "kn-mark" });
    const body = el("div", { class: "kn-body" });
    const group = el("details", { class: "kn-group", open }, el("summary", {}, el("span", {}, title), mark), body);
    const own = settings.map((setting) => {
      const control = make(setting, about, change);
      body.append(control.node);
      return control;
    });
    shown.push({ mark, own });
    host.append(group);
  }
  return (bench, base) => {
    for (const { mark, own } of shown) {
      const changed = own.filter((control) => control.show(bench, base)).length;
      setText(mark, changed ? `${changed} changed` : "");
    }
  };
}

let serial = 0;

function make([key, label, unit, low, high, step, start], about, change) {
  const id = `k${++serial}`;
  const range = about.ranges[key.replace("second_camera", "camera")];
  const help = range?.meaning ?? "";
  const reset = () => { change(key, get(about.base, key) ?? null); document.getElementById(id)?.focus(); };
  const back = el("button", { type: "button", class: "kn-back", title: "Back to the configuration’s value", "aria-label": `${label}: back to the configuration’s value`, hidden: true, onclick: reset }, "↺");
  const name = el("label", { for: id, title: help }, label);
  const finish = (node, read) => ({
    node,
    show(bench, base) {
      const value = get(bench, key), before = get(base, key);
      const changed = JSON.stringify(value ?? null) !== JSON.stringify(before ?? null);
      back.hidden = !changed;
      node.classList.toggle("changed", changed);
      read(value, bench);
      return changed;
    },
  });

  if (unit === "choice") {
    const options = CHOICES[key];
    const onchange = () => change(key, options[select.selectedIndex][0]);
    const select = el("select", { id, onchange }, options.map(([, text], i) => el("option", { value: i }, text)));
    return finish(el("div", { class: "kn kn-choice" }, name, back, select), (value) => { select.selectedIndex = options.findIndex(([v]) => v === (value ?? null)); });
  }
  if (unit === "switch" || unit === "second") {
    const onchange = () => change(key, unit === "second" ? (box.checked ? OPPOSITE : null) : box.checked);
    const box = el("input", { type: "checkbox", id, onchange });
    return finish(el("div", { class: "kn kn-switch" }, box, name, back), (value) => { box.checked = Boolean(value); });
  }

  const take = () => {
    const value = Number(number.value);
    if (number.value !== "" && Number.isFinite(value) && number.checkValidity()) change(key, range?.whole ? Math.round(value) : value);
  };
  const number = el("input", { type: "number", id, step: "any", min: range?.low, max: range?.high, "aria-describedby": help ? `${id}-help` : null, oninput: take });
  const parts = [name, back, number, el("span", { class: "kn-unit" }, unit === "number" ? "" : unit)];
  let slider = null;
  if (unit !== "number") {
    const oninput = () => { number.value = slider.value; take(); };
    slider = el("input", { type: "range", min: low, max: high, step, "aria-label": `${label}${unit ? `, ${unit}` : ""}`, "data-key": key, oninput });
    parts.push(slider);
  }
  if (help) parts.push(el("span", { id: `${id}-help`, class: "unseen" }, help));
  const node = el("div", { class: "kn" });
  let box = null;
  if (start !== undefined) { // a number that may be absent: a switch beside it
    box = el("input", { type: "checkbox", "aria-label": `${label}: set it`, onchange: () => change(key, box.checked ? start : null) });
    parts.unshift(box);
    node.classList.add("kn-optional");
  }
  node.append(...parts);
  return finish(node, (value, bench) => {
    const off = value === null || value === undefined;
    if (box) box.checked = !off;
    number.disabled = off;
    if (slider) slider.disabled = off;
    if (off) number.value = "";
    else if (document.activeElement !== number || Number(number.value) !== value) number.value = tidy(value);
    if (slider && !off) {
      slider.value = value;
      slider.setAttribute("aria-valuetext", `${tidy(value)} ${unit}`);
    }
    if (key.startsWith("second_camera.")) node.hidden = !bench.second_camera;
    if (key === "perception.recall_value") node.hidden = bench.perception.recall !== "fixed";
    if (["perception.burst_frames", "perception.trial", "perception.seed", "perception.trials"].includes(key)) node.hidden = bench.perception.recall === "all";
    if (key === "decision.ttc_s") node.hidden = bench.decision.rule !== "ttc";
  });
}

const tidy = (value) => String(Math.round(value * 1e6) / 1e6);
