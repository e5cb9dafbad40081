// The align page: camera values, marks, fit, save. The server computes everything on the ground.

import { KINDS } from "/static/align-paint.js";
import { Dials, MarkList, NAMES, fitAnswer, rounded, sign } from "/static/align-panels.js";
import { View } from "/static/align-view.js";
import { $, announce, download, el, metres, request, setText, toast } from "/static/ui.js";

let state = null; // the answer of /align/state
let before = null; // the values before the last fit
let marks = [];
let between = [];
let chosen = null;
const free = new Set(["height_m", "pitch_deg"]);

const dials = new Dials(() => {
  showChanges();
  redraw();
});
const view = new View({
  tap: addMark, moved: marksMoved, chosen: choose, removed: removeMark, entered: (mark) => list.focus(mark),
});
const list = new MarkList({
  changed: marksMoved, removed: removeMark, betweenChanged: remember,
  chosen(mark, show) {
    choose(mark);
    if (!show) return;
    view.reveal(mark);
    view.focus(mark);
  },
});

// --- the grid: one request at a time; changes during a request cause one more with the newest values

let requesting = false;
let outdated = false;

async function redraw() {
  if (!view.size || !state) return;
  outdated = true;
  if (requesting) return;
  requesting = true;
  while (outdated) {
    outdated = false;
    try {
      const answer = await request("/align/grid", { json: { values: dials.values, frame: view.size, marks: marks.map(asPoint) } });
      showTrouble("");
      view.setGrid(answer.grid, answer.at_10m && answer.at_10m.pixel);
      showTen(answer.at_10m);
      showReadings(answer.marks);
    } catch (error) {
      showTrouble(error.message);
    }
  }
  requesting = false;
}

function showTrouble(text) {
  const place = $("#trouble");
  setText(place, text);
  place.hidden = !text;
}

function showTen(ten) {
  const place = $("#ten-text");
  dials.showEffects(ten);
  if (!ten) return setText(place, "10 m is not in view.");
  if (ten.reads_m === null) return place.replaceChildren("10 m mark: ", el("b", {}, "above the horizon"), " now.");
  const moved = ten.reads_m - ten.was_m;
  place.replaceChildren("10 m mark now reads ", el("b", { id: "ten-figure" }, metres(ten.reads_m, 2)),
    Math.abs(moved) < 0.005 ? "" : ` (${sign(moved, 2)}\u00a0m)`);
}

// --- marks

function asPoint(mark) {
  return { name: mark.name, u: mark.u, v: mark.v, distance_m: mark.distance_m ?? null, right_m: mark.right_m ?? null };
}

function showReadings(readings) {
  for (const reading of readings) {
    const mark = marks.find((item) => item.name === reading.name);
    if (!mark) continue;
    mark.goal = reading.measured_at ?? null;
    mark.off = !reading.on_ground;
    if (!reading.on_ground) {
      mark.says = "above the horizon: not on the ground";
      mark.tag = `${mark.name}: above the horizon`;
      continue;
    }
    const side = `${metres(Math.abs(reading.right_m), 2)} ${reading.right_m < 0 ? "left" : "right"}`;
    mark.says = `reads ${metres(reading.distance_m, 2)}, ${side}`;
    mark.tag = `${mark.name}: ${metres(reading.distance_m, 2)}`;
    if (typeof mark.distance_m === "number") {
      const off = reading.distance_m - mark.distance_m;
      mark.says += `; off ${sign(100 * off, 0)} cm`;
      if (Number.isFinite(mark.right_m)) mark.says += `, sideways ${sign(100 * (reading.right_m - mark.right_m), 0)} cm`;
    }
  }
  showMarks();
}

function showMarks() {
  for (const mark of marks) mark.chosen = mark === chosen;
  view.setMarks(marks);
  list.show(marks);
  showWants();
}

function addMark(u, v, more = {}) {
  if (marks.length >= 40) return toast("40 marks are enough.", "bad");
  let number = 1;
  while (marks.some((mark) => mark.name === String(number))) number += 1;
  const id = Math.max(0, ...marks.map((mark) => mark.id)) + 1;
  const tenth = (value, most) => Math.round(Math.min(Math.max(value, 0), most) * 10) / 10;
  const mark = {
    id, name: more.name ?? String(number), distance_m: more.distance_m ?? null, right_m: more.right_m ?? null,
    u: tenth(u, view.size.width - 1), v: tenth(v, view.size.height - 1),
  };
  marks.push(mark);
  choose(mark);
  list.showBetween(between, marks);
  marksMoved();
  if (!more.name) announce(`Mark ${mark.name} set. Enter its distance under Marks.`);
}

function replaceMarks(newMarks, newBetween) {
  [marks, between, chosen] = [newMarks, newBetween, null];
  list.showBetween(between, marks);
  showMarks();
}

function removeMark(mark) {
  marks = marks.filter((item) => item !== mark);
  between = between.filter((pair) => pair.first !== mark.id && pair.second !== mark.id);
  if (chosen === mark) chosen = null;
  list.showBetween(between, marks);
  showMarks();
  marksMoved();
  announce(`Mark ${mark.name} deleted.`);
  $("#stage").focus({ preventScroll: true });
}

function choose(mark) {
  if (chosen === mark) return;
  chosen = mark;
  showMarks();
}

function marksMoved() {
  remember();
  showWants();
  redraw();
}

function points() {
  const measured = marks.filter((mark) => typeof mark.distance_m === "number" && mark.distance_m > 0);
  const name = (id) => marks.find((mark) => mark.id === id)?.name;
  const pairs = between.filter((pair) => pair.distance_m > 0 && pair.first !== pair.second
    && [pair.first, pair.second].every((id) => measured.some((mark) => mark.id === id)));
  return {
    frame: view.size,
    marks: measured.map(asPoint),
    between: pairs.map((pair) => ({ first: name(pair.first), second: name(pair.second), distance_m: pair.distance_m })),
    values: dials.values,
    free: Object.keys(NAMES).filter((key) => free.has(key)),
  };
}

function showWants() {
  const without = marks.filter((mark) => !(mark.distance_m > 0)).map((mark) => mark.name);
  setText($("#fit-wants"), without.length ? `Left out, because no distance is given: mark ${without.join(", ")}.` : "");
  $("#fit").disabled = without.length === marks.length || free.size === 0;
}

// Marks are kept across a reload: a phone drops pages from its memory.
const STORAGE_KEY = "bikeped-align";

function remember() {
  try {
    localStorage.setItem(STORAGE_KEY, JSON.stringify({ size: view.size, marks: marks.map((mark) => ({ id: mark.id, ...asPoint(mark) })), between }));
  } catch { /* storage is off: marks are not kept */ }
}

function recall() {
  try {
    const kept = JSON.parse(localStorage.getItem(STORAGE_KEY));
    if (!kept || kept.size.width !== view.size.width || kept.size.height !== view.size.height) return;
    replaceMarks(kept.marks.filter((mark) => Number.isFinite(mark.u) && Number.isFinite(mark.v)), kept.between ?? []);
    if (marks.length) toast(`${marks.length} mark${marks.length > 1 ? "s" : ""} from before.`);
  } catch { replaceMarks([], []); }
}

// --- fit

async function fit() {
  const button = $("#fit"), place = $("#fit-answer");
  button.disabled = true;
  try {
    const answer = await request("/align/fit", { json: points() });
    if (answer.refused) throw new Error(`${answer.refused[0].toUpperCase()}${answer.refused.slice(1)}.`);
    before = { ...dials.values };
    $("#undo").hidden = false;
    const next = Object.fromEntries(Object.entries(answer.values).map(([key, value]) => [key, rounded(key, value)]));
    place.replaceChildren(...fitAnswer(answer, next));
    dials.setAll(next);
  } catch (error) {
    place.replaceChildren(el("p", { class: "error" }, error.message));
  } finally {
    showWants();
  }
}

// --- save

function differing() {
  return Object.keys(NAMES).filter((key) => key in dials.values
    && Math.abs(dials.values[key] - rounded(key, state.filed[key])) > 0.5 * 10 ** -NAMES[key][2]);
}

function showChanges() {
  const keys = differing();
  $("#changes tbody").replaceChildren(...keys.map((key) => el("tr", {},
    el("th", { scope: "row" }, `camera.${key}`),
    el("td", { class: "number" }, `${rounded(key, state.filed[key])}`), el("td", { class: "number" }, el("b", {}, `${dials.values[key]}`)))));
  $("#changes").hidden = keys.length === 0;
  $("#no-changes").hidden = keys.length > 0;
  $("#save").disabled = keys.length === 0 || state.cannot_save !== null;
  $("#by-hand").hidden = keys.length === 0;
  $("#by-hand").open = state.cannot_save !== null;
  setText($("#yaml"), `camera:\n${keys.map((key) => `  ${key}: ${dials.values[key]}\n`).join("")}`);
}

function showFile() {
  setText($("#file"), state.source.split("/").pop());
  const place = $("#save-why");
  const differs = Object.keys(NAMES).some((key) => Math.abs(state.running[key] - state.filed[key]) > 1e-3);
  const why = state.cannot_save ?? (differs && state.live ? "The running service has other values than the file: it reads the file when it starts." : differs ? "--set gives other values than the file." : "");
  setText(place, why);
  place.hidden = !why;
}

async function save() {
  const button = $("#save"), place = $("#saved");
  button.disabled = true;
  try {
    const answer = await request("/align/save", { json: { values: Object.fromEntries(differing().map((key) => [key, dials.values[key]])), sha256: state.sha256 } });
    state = await request("/align/state");
    showFile();
    place.replaceChildren(
      el("p", { class: "verdict ok-mark" }, `Saved into ${answer.config}.`),
      el("p", { class: "note" }, "The file before: ", el("code", {}, answer.backup.split("/").pop()), "."),
      el("p", { class: answer.reference ? "note" : "warn" }, answer.reference ? `What the camera sees is in ${answer.reference.split("/").pop()}: the service reports when it has moved.` : `The camera’s view is not saved: ${answer.no_reference}.`),
      answer.restart ? el("p", {}, "The service reads it after a restart: ", el("code", {}, "sudo systemctl restart bikeped")) : null,
      answer.promoted ? el("p", { class: "warn" }, "The promoted decision was measured with the camera’s previous values: run ", el("code", {}, "bikeped conformance gate"), " again.") : null);
  } catch (error) {
    place.replaceChildren(el("p", { class: "error" }, error.message),
      error.status === 409 ? el("button", { type: "button", onclick: () => location.reload() }, "Open the page again") : null);
  }
  showChanges();
}

// --- the rest

function adding(on) {
  view.adding = on;
  $("#add").setAttribute("aria-pressed", String(on));
  for (const id of ["#here", "#hint", "#cross"]) $(id).hidden = !on;
  $("#stage").classList.toggle("adding", on);
}

async function newPicture() {
  const blank = $("#blank");
  try {
    const answer = await fetch("/align/frame.jpg");
    if (!answer.ok) throw new Error((await answer.json()).error);
    await view.setPicture(await answer.blob());
    blank.hidden = true;
  } catch (error) {
    setText(blank, error.message);
    blank.hidden = Boolean(view.size);
    if (view.size) toast(error.message, "bad");
  }
}

async function importMarks(file) {
  try {
    const data = JSON.parse(await file.text());
    const share = view.size.width / data.frame.width;
    if (Math.abs(view.size.height / data.frame.height - share) > 0.01) throw new Error("it is for pictures of other proportions");
    replaceMarks([], []);
    for (const mark of data.marks.slice(0, 40)) addMark(mark.u * share, mark.v * share, { ...mark, name: String(mark.name) });
    const id = (name) => marks.find((mark) => mark.name === name)?.id;
    between = (data.between ?? []).map((pair) => ({ first: id(pair.first), second: id(pair.second), distance_m: pair.distance_m })).filter((pair) => pair.first && pair.second);
    list.showBetween(between, marks);
    marksMoved();
  } catch (error) {
    toast(`${file.name}: cannot be read as marks (${error.message})`, "bad");
  }
}

function listen() {
  const steps = (big) => {
    dials.setCoarse(big);
    $("#fine").setAttribute("aria-pressed", String(!big));
    $("#coarse").setAttribute("aria-pressed", String(big));
  };
  const clicks = {
    add: () => adding(!view.adding),
    here: () => addMark(...view.middle()),
    in: () => view.zoom(1.5),
    out: () => view.zoom(1 / 1.5),
    all: () => view.show(view.contain()),
    renew: newPicture,
    fine: () => steps(false),
    coarse: () => steps(true),
    back: () => dials.setAll(state.filed),
    fit,
    save,
    export: () => download(`${JSON.stringify(points(), null, 2)}\n`, "points.json", "application/json"),
    import: () => $("#import-file").click(),
    undo() {
      if (before) dials.setAll(before);
      $("#undo").hidden = true;
      $("#fit-answer").replaceChildren();
      $("#fit").focus();
    },
    clear() {
      replaceMarks([], []);
      marksMoved();
    },
    "add-between"() {
      between.push({ first: marks[0].id, second: marks[marks.length - 1].id, distance_m: null });
      list.showBetween(between, marks);
    },
  };
  for (const [id, act] of Object.entries(clicks)) $(`#${id}`).addEventListener("click", () => act());
  $("#import-file").addEventListener("change", (event) => {
    if (event.target.files[0]) importMarks(event.target.files[0]);
    event.target.value = "";
  });
}

// Checkboxes for the kinds of lines shown and for the values to fit.
function makeChoices() {
  const choice = (checked, value, change, ...label) => {
    const onchange = (event) => change(event.target.checked);
    return el("label", { class: "check" }, el("input", { type: "checkbox", checked, value, onchange }), ...label);
  };
  for (const [kind, { label, colour }] of Object.entries(KINDS)) {
    const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = colour;
    $("#kinds").append(choice(true, kind, (shown) => {
      view.hidden[shown ? "delete" : "add"](kind);
      view.repaint();
    }, swatch, label));
  }
  for (const [key, [name]] of Object.entries(NAMES)) {
    $("#free").append(choice(free.has(key), key, (on) => {
      free[on ? "add" : "delete"](key);
      showWants();
    }, name));
  }
}

async function open() {
  try {
    state = await request("/align/state");
  } catch (error) {
    showTrouble(error.message);
    return;
  }
  dials.make(state.fields, state.start);
  makeChoices();
  $("#renew").hidden = !state.live;
  showFile();
  listen();
  await newPicture();
  if (view.size) recall();
  showMarks();
  redraw();
  document.documentElement.dataset.ready = "align";
}

open();
