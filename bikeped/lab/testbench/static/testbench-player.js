// The playback of a scenario: the frame shown, its sentence, the views, the keys. The report has it too.

import { $, el, percent, seconds, setText, stateIcon, STATES } from "/static/ui.js";
import { planWords } from "/static/testbench-plan.js";
import { spans, timeline } from "/static/testbench-timeline.js";
import { NAMES, TIERS, chosenPair, configurationName, headline, judgement, spoken, stateAt } from "/static/testbench-words.js";

const LEGEND = [["pedestrian", "pedestrian"], ["cyclist", "cyclist"], ["vehicle", "vehicle"], ["ring", "detected position"], ["pair", "the pair that decides"], ["seen", "ground the camera sees"]];
const TIME_LEGEND = [["actionable", "danger, a warning helps"], ["imminent", "danger, too late to react"], ["true", "true distance"], ["measured", "measured distance"], ["band", "distances that can alert"], ["onset", "alert begins"], ["closest", "closest approach"]];

// `options` = {diagram, plan(canvas, where), handles(), editing()}; elements by their ids.
export function player(options) {
  let play = null, frame = 0, playing = 0, spokenAt = -1, first = true;
  const where = () => ({ play, frame, editing: options.editing(), handles: options.handles() });
  const picture = options.plan($("#plan"), where);
  const line = timeline($("#timeline"), where, (f) => { stop(); seek(f); });
  const track = $("#track");
  legend($("#legend"), LEGEND);
  legend($("#time-legend"), TIME_LEGEND);

  function seek(next) {
    if (!play) return;
    frame = Math.min(Math.max(Math.round(next), 0), play.frames - 1);
    paint();
  }

  function paint() {
    if (!play) return;
    const side = play.sides[0];
    const state = stateAt(side, frame);
    const lamp = $("#lamp");
    if (lamp.dataset.state !== state || !lamp.firstChild) {
      lamp.dataset.state = state;
      lamp.replaceChildren(stateIcon(state), el("b", {}, STATES[state]));
    }
    setText($("#headline"), headline(play, side, frame));
    setText($("#sentence"), side.sentence[frame]);
    const verdict = judgement(play, side, frame);
    $("#verdict").dataset.good = verdict.neutral ? "late" : String(verdict.good);
    const [word, why] = ensure($("#verdict"));
    setText(word, verdict.word);
    setText(why, verdict.why);
    setText($("#clock"), `${(frame / play.fps).toFixed(2)} s, frame ${frame}`);
    options.diagram(play, side, frame);
    picture.paint();
    line.paint();
    track.setAttribute("aria-valuenow", String(frame));
    if (!playing && spokenAt !== frame) { track.setAttribute("aria-valuetext", spoken(play, side, frame)); spokenAt = frame; }
    if (!playing) $("#plan").setAttribute("aria-label", planWords(play, frame));
  }

  function ensure(host) {
    if (!host.firstChild) host.append(el("b", { class: "tb-word" }), el("span", { class: "tb-reason" }));
    return [host.firstChild, host.lastChild];
  }

  function stop() {
    if (playing) cancelAnimationFrame(playing);
    playing = 0;
    $("#play").setAttribute("aria-pressed", "false");
    setText($("#play"), "Play");
  }

  function start() {
    if (frame >= play.frames - 1) frame = 0;
    const began = performance.now(), from = frame;
    $("#play").setAttribute("aria-pressed", "true");
    setText($("#play"), "Pause");
    const step = (now) => {
      const next = from + Math.floor((now - began) / 1000 * play.fps);
      if (next >= play.frames - 1) { stop(); seek(play.frames - 1); return; }
      playing = requestAnimationFrame(step);
      if (next !== frame) seek(next);
    };
    playing = requestAnimationFrame(step);
  }

  const toggle = () => { if (!play) return; if (playing) { stop(); paint(); } else start(); };
  $("#play").addEventListener("click", toggle);
  $("#to-onset").addEventListener("click", () => { stop(); const [onset] = play.sides[0].onsets; if (onset) seek(onset.frame); track.focus({ preventScroll: true }); });
  $("#to-closest").addEventListener("click", () => { stop(); if (play.closest_s !== null) seek(play.closest_s * play.fps); track.focus({ preventScroll: true }); });
  $("#fit").addEventListener("click", () => picture.fit());
  const keys = (event) => {
    const stepping = { ArrowLeft: -1, ArrowRight: 1, ArrowDown: -1, ArrowUp: 1, PageDown: -30, PageUp: 30 }[event.key];
    if (stepping) { stop(); seek(frame + stepping * (event.shiftKey && Math.abs(stepping) === 1 ? 30 : 1)); }
    else if (event.key === "Home") { stop(); seek(0); }
    else if (event.key === "End") { stop(); seek(play.frames - 1); }
    else if (event.key === " ") toggle();
    else return;
    event.preventDefault();
  };
  track.addEventListener("keydown", (event) => { if (!event.ctrlKey && !event.altKey && !event.metaKey) keys(event); });
  document.addEventListener("keydown", (event) => {
    if (event.target === document.body && !event.ctrlKey && !event.altKey && !event.metaKey && ["ArrowLeft", "ArrowRight", " ", "Home", "End"].includes(event.key)) keys(event);
  });

  return {
    paint,
    seek,
    rewind() { stop(); first = true; },
    load(next) {
      play = next;
      track.setAttribute("aria-valuemin", "0");
      track.setAttribute("aria-valuemax", String(play.frames - 1));
      if (first) frame = opening(play);
      first = false;
      frame = Math.min(frame, play.frames - 1);
      spokenAt = -1;
      line.fit(play.sides.length);
      setText($("#story"), play.scenario.story);
      $("#to-onset").disabled = !play.sides[0].onsets.length;
      $("#to-closest").disabled = play.closest_s === null;
      figures($("#figures"), play);
      changesTable($("#table"), play);
      setText($("#table-note"), `${play.scenario.name}: every change of a state or of the danger.`);
      paint();
    },
  };
}

// The first frame shown: half a second into the first alert.
function opening(play) {
  const [onset] = play.sides[0].onsets;
  return onset ? Math.min(onset.frame + 15, play.frames - 1) : Math.round(play.frames / 2);
}

function legend(host, entries) {
  host.replaceChildren(...entries.map(([sign, text]) => el("li", {}, el("span", { class: `lg lg-${sign}`, "aria-hidden": "true" }), text)));
}

function figures(host, play) {
  const rows = [
    ["Sensitivity", (s) => `${percent(s.metrics.sensitivity)} (${s.counts.actionable_alert} of ${s.counts.actionable} frames)`],
    ["Specificity", (s) => `${percent(s.metrics.specificity)} (${s.counts.calm - s.counts.calm_alert} of ${s.counts.calm})`],
    ["Missed severity", (s) => percent(s.metrics.sev_fn)],
    ["Shortest budget", (s) => seconds(s.metrics.min_warning_budget_s, 2)],
    ["First alert before closest approach", (s) => seconds(s.metrics.first_onset_lead_s, 2)],
    ["Time red", (s) => percent(s.metrics.fatigue)],
  ];
  const many = play.sides.length > 1;
  host.classList.toggle("many", many);
  host.replaceChildren(
    el("caption", { class: "unseen" }, "Figures of this scenario"),
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "This scenario"), rows.map(([name]) => el("th", { scope: "col", class: "number" }, name)))),
    el("tbody", {}, play.sides.map((side) => el("tr", {}, el("th", { scope: "row" }, configurationName(side.name)), rows.map(([, say]) => el("td", { class: "number" }, say(side)))))));
}

// The playback as a table: one row for every change.
function changesTable(host, play) {
  const marks = new Set([0]);
  for (const codes of [play.truth.tier, ...play.sides.map((side) => side.state)]) for (const { from } of spans(codes)) marks.add(from);
  const frames = [...marks].sort((a, b) => a - b);
  host.replaceChildren(
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Time"), play.sides.map((side) => el("th", { scope: "col" }, configurationName(side.name))), el("th", { scope: "col" }, "Danger (truth)"), el("th", { scope: "col", class: "number" }, "Pair, m"), el("th", { scope: "col" }, "Sentence of the rule"))),
    el("tbody", {}, frames.map((f) => {
      const pair = chosenPair(play, play.sides[0], f);
      return el("tr", {}, el("th", { scope: "row" }, `${(f / play.fps).toFixed(2)} s`), play.sides.map((side) => el("td", {}, STATES[NAMES[side.state[f]]])), el("td", {}, { none: "–", actionable: "yes, a warning helps", imminent: "yes, too late" }[TIERS[play.truth.tier[f]]]), el("td", { class: "number" }, pair ? pair.distance.toFixed(2) : "–"), el("td", {}, play.sides[0].sentence[f]));
    })));
}
