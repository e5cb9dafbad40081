// Steps through the alerts of a traffic run, nuisance first, from the data in the page.

import { $, calm, canvasOf, el, metres, seconds } from "/static/ui.js";
import { NAMES } from "/static/testbench-words.js";
import { drawStrip, stripWords } from "/static/testbench-timeline.js";
import { plan, planWords } from "/static/testbench-plan.js";

const { scenes, alerts } = JSON.parse($("#data").textContent);
const FPS = 10, TESTS = ["", "", "", "", "", "", "fires"];
const KINDS = { nuisance: "Nuisance", conflict: "Real conflict near", danger: "Danger" };
const WHY = {
  nuisance: "Nuisance: no danger in it, and no real conflict within 3 s after it.",
  conflict: "No moment of danger by the labels, but a real conflict belongs to it.",
  danger: "There is danger in it.",
};
let shown = alerts, at = 0, frame = 0, timer = null;

const playOf = (alert) => ({
  scenario: { name: `${scenes[alert.scene].strip.name} ${alert.begin_s}` },
  frames: alert.raw.length, fps: FPS, cameras: scenes[alert.scene].cameras,
  agents: alert.agents, tracks: alert.tracks, sides: [alert.side], tests: TESTS,
});
let play = null;
const canvas = $("#plan");
const view = plan(canvas, () => ({ play, frame, editing: false, handles: null }));

function paint() {
  const alert = shown[at];
  if (!alert) return;
  const light = NAMES[alert.side.state[frame]], raw = NAMES[alert.raw[frame]];
  $("#clock").textContent = seconds(alert.first_s + frame / FPS);
  $("#moment").value = frame;
  $("#sentence").textContent = alert.sentence[frame];
  const held = light === "ALERT" && raw !== "ALERT" ? "; held, the rule says " + raw : "";
  $("#truth").textContent = `The light shows ${light}${held}. ${alert.danger[frame] ? "By the labels there is danger now." : "By the labels there is no danger now."}`;
  canvas.setAttribute("aria-label", planWords(play, frame));
  view.paint();
}

function stop() {
  clearInterval(timer);
  timer = null;
  $("#play").textContent = "Play";
}

function choose(next) {
  stop();
  at = Math.min(Math.max(next, 0), shown.length - 1);
  const alert = shown[at];
  for (const button of $("#alerts").querySelectorAll("button")) button.setAttribute("aria-current", String(Number(button.dataset.at) === at));
  $("#before").disabled = at <= 0;
  $("#next").disabled = at >= shown.length - 1;
  $("#place").textContent = alert ? `Alert ${at + 1} of ${shown.length}` : "No alerts";
  for (const id of ["#play", "#moment"]) $(id).disabled = !alert;
  play = alert ? playOf(alert) : null;
  if (!alert) {
    for (const id of ["#why", "#sentence", "#truth", "#clock"]) $(id).textContent = "";
    view.paint();
    return;
  }
  const near = alert.nearest_m === null ? "no cyclist and pedestrian were in view together" : `the nearest pair in view came within ${metres(alert.nearest_m)}`;
  $("#why").textContent = `${WHY[alert.kind]} Red for ${seconds(alert.seconds)}; ${near}.`;
  $("#moment").max = play.frames - 1;
  frame = alert.onset;
  $(`#alerts [data-at="${at}"]`).scrollIntoView({ block: "nearest" });
  paint();
}

function list() {
  const scene = $("#scene").value;
  shown = scene === "" ? alerts : alerts.filter((alert) => alert.scene === Number(scene));
  $("#alerts").replaceChildren(...shown.map((alert, i) => el("li", {}, el("button",
    { type: "button", "data-at": i, "data-kind": alert.kind, onclick: () => choose(i) },
    `${KINDS[alert.kind]}, ${seconds(alert.seconds)}`,
    el("small", {}, `${scenes[alert.scene].strip.name}, at ${seconds(alert.begin_s)}, ${alert.nearest_m === null ? "no pair in view" : `nearest pair ${metres(alert.nearest_m)}`}`)))));
  choose(0);
}

$("#scene").replaceChildren(el("option", { value: "" }, `all scenes (${alerts.length})`), ...scenes.map(({ strip }, i) =>
  el("option", { value: i }, `${strip.name} (${alerts.filter((alert) => alert.scene === i).length})`)));
$("#scene").addEventListener("change", list);
$("#before").addEventListener("click", () => choose(at - 1));
$("#next").addEventListener("click", () => choose(at + 1));
$("#moment").addEventListener("input", () => { stop(); frame = Number($("#moment").value); paint(); });
$("#play").addEventListener("click", () => {
  if (timer) { stop(); return; }
  if (frame >= play.frames - 1) frame = 0;
  $("#play").textContent = "Pause";
  timer = setInterval(() => {
    frame = Math.min(frame + 1, play.frames - 1);
    paint();
    if (frame === play.frames - 1) stop();
  }, calm() ? 400 : 1000 / FPS);
});
$("#strips").replaceChildren(...scenes.map(({ strip }, i) => {
  const drawn = el("canvas", { role: "img", "aria-label": stripWords(strip) });
  canvasOf(drawn, (context, width, height) => drawStrip(context, width, height, strip, false));
  const open = () => { $("#scene").value = i; list(); $("#watch").scrollIntoView(); };
  return el("li", {}, el("button", { type: "button", class: "su-open", onclick: open }, strip.name), drawn);
}));
list();
document.documentElement.dataset.ready = "traffic";
