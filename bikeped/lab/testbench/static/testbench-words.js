// Texts of the pages, and access to a playback's data. All numbers and results of checks come from the
// deployed Python code.

import { metres, seconds } from "/static/ui.js";

export const NAMES = ["IDLE", "SAFE", "WARNING", "ALERT"];
const LIGHT = { IDLE: "blue", SAFE: "green", WARNING: "yellow", ALERT: "red" };
export const TIERS = ["none", "actionable", "imminent"];

// Names of configurations as people read them.
export function configurationName(name, short = false) {
  const words = {
    bench: ["your settings", "Your settings"], configured: ["in force", "In force"],
    selected: ["selected", "Selected (paper)"], conservative: ["conservative", "Conservative"],
    narrow: ["narrow", "Narrow"], speed_adaptive: ["speed-adaptive", "Speed-adaptive"],
    distance_only: ["distance only", "Distance only"], naive_closing: ["naive closing", "Naive closing"],
    ttc: ["time to collision", "Time to collision"],
  };
  return (words[name] ?? [name, name])[short ? 0 : 1];
}

export const stateAt = (side, frame) => NAMES[side.state[frame]];

// A pair of a frame by its place in the side's lists, with the tests it passes by name.
function pairAt(play, side, at) {
  if (at < 0 || at === undefined) return null;
  const pairs = side.pairs;
  const passes = Object.fromEntries(play.tests.map((test, bit) => [test, (pairs.passes[at] >> bit & 1) === 1]));
  const pick = (key) => pairs[key][at];
  return {
    cyclist: pick("cyclist"), pedestrian: pick("pedestrian"), passes, distance: pick("distance_m"),
    then: pick("then_m"), lookback: pick("lookback_s"), moved: pick("displacement_m"),
    speed: pick("speed_mps"), dMax: pick("d_max_m"), reach: pick("reach_m"),
  };
}

export const chosenPair = (play, side, frame) => pairAt(play, side, side.chosen[frame]);

// All pairs of a frame.
export function pairsAt(play, side, frame) {
  const found = [];
  for (let at = side.pairs.start[frame]; at < side.pairs.start[frame + 1]; at++) found.push({ at, ...pairAt(play, side, at) });
  return found;
}

// The tracks of a frame: id, kind, x, y.
export function tracksAt(play, frame) {
  const { start, id, kind, xy } = play.tracks;
  const found = [];
  for (let row = start[frame]; row < start[frame + 1]; row++) found.push({ id: id[row], kind: kind[row], x: xy[2 * row], y: xy[2 * row + 1] });
  return found;
}

// Why the light shows its colour, without terms of the rule.
export function headline(play, side, frame) {
  const state = stateAt(side, frame);
  const people = side.pedestrians[frame] === 1 ? "a pedestrian is" : `${side.pedestrians[frame]} pedestrians are`;
  const start = `The light is ${LIGHT[state]}: `;
  if (state === "IDLE") return `${start}no pedestrian is in view.`;
  const since = side.since_cyclist_s[frame];
  if (state === "SAFE") return `${start}${people} in view, and no cyclist has been seen for ${since === null ? "a while" : seconds(since)}.`;
  const pair = chosenPair(play, side, frame);
  if (!pair) return `${start}${people} in view, and a cyclist was seen ${seconds(since)} ago.`;
  const apart = metres(pair.distance);
  const rule = side.decision.rule;
  if (state === "ALERT") {
    if (rule === "distance") return `${start}a cyclist and a pedestrian are only ${apart} apart.`;
    if (rule === "ttc") return `${start}a cyclist and a pedestrian, ${apart} apart, would meet within ${seconds(side.decision.ttc_s, 0)}.`;
    return `${start}a cyclist and a pedestrian are ${apart} apart and getting closer.`;
  }
  return `${start}a cyclist and a pedestrian are in view, ${apart} apart, but ${whyNot(side, pair)}.`;
}

function whyNot(side, pair) {
  const { passes } = pair;
  if (!passes.far_enough) return "too near for a warning to help";
  if (!passes.near_enough) return "too far apart to matter yet";
  if (!passes.in_range) return "too far from the camera to be judged";
  if (side.decision.rule === "predictive") return "they are not on course to meet";
  if (!passes.judged) return "one of them has only just appeared";
  if (side.decision.rule === "ttc") return passes.closing ? "they would not meet soon" : "not getting closer";
  if (!passes.closing) return "not getting closer";
  return "the cyclist hardly moves";
}

// Whether the state is right by the ground truth of the frame.
export function judgement(play, side, frame) {
  const tier = TIERS[play.truth.tier[frame]];
  const alert = stateAt(side, frame) === "ALERT";
  const ttc = play.truth.ttc_s[frame];
  const contact = ttc === null ? "they will pass close to one another" : `contact in ${seconds(ttc)}`;
  if (tier === "actionable") {
    return alert
      ? { good: true, word: "Warned in time", why: `Danger: ${contact}, and a warning still helps.` }
      : { good: false, word: "Missed", why: `Danger: ${contact}. A warning would still help, and there is none.` };
  }
  if (tier === "imminent") return { good: alert, word: alert ? "Warned, but late" : "Too late to warn", why: `Danger: ${contact}, sooner than a distracted person can react.`, neutral: true };
  return alert
    ? { good: false, word: "Alert without danger", why: "By the ground truth there is no danger now." }
    : { good: true, word: "Correctly no alert", why: "By the ground truth there is no danger now." };
}

// The time in words, for screen readers.
export function spoken(play, side, frame) {
  return `${(frame / play.fps).toFixed(2)} seconds. ${headline(play, side, frame)} ${judgement(play, side, frame).word}.`;
}
