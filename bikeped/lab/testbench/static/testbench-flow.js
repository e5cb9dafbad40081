// The pipeline as a diagram: the output of each stage in the frame shown, and which checks pass.

import { el, metres, seconds, setText, stateIcon, STATES } from "/static/ui.js";
import { chosenPair, stateAt, tracksAt } from "/static/testbench-words.js";

const COUNT = (n, one, many) => (n === 1 ? `1 ${one}` : `${n} ${many}`);

// Builds the diagram in `host`; returns the function that shows a frame of a side.
export function flow(host) {
  const stages = el("ol", { class: "fl-stages" });
  const perception = stage(stages, "Camera");
  const place = stage(stages, "Ground");
  const tracker = stage(stages, "Tracker");
  const prediction = stage(stages, "Prediction");
  const decide = el("ol", { class: "fl-questions" });
  const pedestrian = question(decide, "Pedestrian present?", "IDLE", "no");
  const memory = question(decide, "Cyclist seen recently?", "SAFE", "no");
  const closing = question(decide, "Closing in?", "WARNING", "no");
  const end = el("li", { class: "fl-end" });
  const out = exit("ALERT", "yes");
  end.append(out);
  decide.append(end);
  const tests = el("ul", { class: "fl-tests" });
  closing.item.append(tests);
  const rows = new Map();
  host.replaceChildren(stages, el("h3", { class: "fl-title" }, "Decision, in three questions"), decide);

  return (play, side, frame) => {
    const state = stateAt(side, frame);
    const tracks = tracksAt(play, frame);
    const here = play.agents.filter((agent) => agent.true[2 * frame] !== null);
    const missed = play.agents.filter((agent) => agent.missed[frame]);
    const found = play.agents.filter((agent) => agent.detected[2 * frame] !== null);
    const late = play.delay_frames ? `, ${Math.round(1000 * play.delay_frames / play.fps)} ms ago` : "";
    perception.show(`${found.length} of ${here.length} seen${missed.length ? `, ${COUNT(missed.length, "miss", "misses")}` : ""}${late}`, missed.length > 0);
    const errors = found.map((agent) => agent.error_m[frame]).filter((value) => value !== null);
    const [least, most] = [Math.min(...errors), Math.max(...errors)].map((e) => e.toFixed(2));
    place.show(!errors.length ? "no positions" : least === most ? `error ${most} m` : `error ${least} to ${most} m`);
    const coasting = tracks.length - found.length;
    tracker.show(tracks.length ? `${COUNT(tracks.length, "track", "tracks")}${coasting > 0 ? `, ${coasting} predicted without detection` : ""}` : "no tracks", coasting > 0);
    prediction.show(play.order && play.delay_frames ? `${play.delay_frames} frames ahead by ${play.order === 1 ? "velocity" : "velocity and acceleration"}` : "none");

    const people = side.pedestrians[frame];
    pedestrian.show(people > 0, people ? `yes, ${people}` : "no", state === "IDLE", true);
    const since = side.since_cyclist_s[frame];
    const window = side.memory_s > 0 ? `within ${seconds(side.memory_s, 2)}` : "now";
    memory.show(side.remembered[frame], since === null ? `never (asked: ${window})` : `${since === 0 ? "now" : `${seconds(since, 2)} ago`} (asked: ${window})`, state === "SAFE", people > 0);
    const pair = chosenPair(play, side, frame);
    const asked = people > 0 && side.remembered[frame];
    closing.show(state === "ALERT", !asked ? "not asked" : pair ? `cyclist ${pair.cyclist}, pedestrian ${pair.pedestrian}` : "no pair to ask about", state === "WARNING", asked);
    end.classList.toggle("lit", state === "ALERT");
    light(out, state === "ALERT");
    showTests(tests, rows, side.decision, side, asked ? pair : null);
  };
}

function stage(list, title) {
  const value = el("span", { class: "fl-value" });
  const item = el("li", { class: "fl-stage" }, el("span", { class: "fl-name" }, title), value);
  list.append(item);
  return {
    show(text, warn = false) {
      setText(value, text);
      item.classList.toggle("warn", warn);
    },
  };
}

function question(list, title, state, answer) {
  const value = el("span", { class: "fl-value" });
  const chip = exit(state, answer);
  const body = el("div", { class: "fl-body" }, el("span", { class: "fl-name" }, title), value);
  const item = el("li", { class: "fl-question" }, body, chip);
  list.append(item);
  return {
    item,
    show(passes, text, ends, asked) {
      setText(value, text);
      item.classList.toggle("passes", passes && asked);
      item.classList.toggle("off", !asked);
      item.classList.toggle("ends", ends);
      light(chip, ends);
    },
  };
}

function exit(state, answer) {
  const chip = el("span", { class: "fl-exit", "data-state": state }, el("span", { class: "fl-answer" }, answer), stateIcon(state), el("span", {}, STATES[state]));
  chip.append(el("span", { class: "unseen fl-now" }));
  return chip;
}

function light(chip, lit) {
  chip.classList.toggle("lit", lit);
  setText(chip.querySelector(".fl-now"), lit ? " (now)" : "");
}

// The checks of the rule: texts, values and a scale. Values and results are the rule's own; without
// `judged` the later checks were not evaluated.
function testsOf(decision, side, pair) {
  const frames = decision.lookback_frames;
  const reach = Math.max(30, decision.d_max_m);
  const list = [
    { key: "far_enough", text: "not too near", shows: `d ${plain(pair?.distance)} ≥ ${metres(decision.d_min_m, 2)}`, scale: [pair?.distance, decision.d_min_m, null, reach] },
    { key: "near_enough", text: "near enough", shows: `d ${plain(pair?.distance)} ≤ ${metres(pair?.dMax ?? decision.d_max_m, 2)}${pair && pair.dMax > decision.d_max_m + 1e-6 ? " to stop" : ""}`, scale: [pair?.distance, null, pair?.dMax ?? decision.d_max_m, reach] },
    { key: "in_range", text: "both in range", shows: `${plain(pair?.reach)} ≤ ${metres(decision.max_range_m, 2)}`, scale: [pair?.reach, null, decision.max_range_m, 1.3 * decision.max_range_m] },
  ];
  const judged = pair?.passes.judged;
  const gone = judged ? pair.then - pair.distance : null;
  const approach = judged ? `${plain(pair.distance)} < ${metres(pair.then, 2)}` : `than ${frames} frames ago`;
  if (decision.rule === "distance") return list;
  if (decision.rule === "ttc") {
    const speed = judged ? gone / pair.lookback : null;
    return [...list,
      { key: "closing", late: true, text: "closing", shows: judged ? `${speed.toFixed(2)} > 0.10 m/s` : approach, scale: [speed, 0.1, null, 12] },
      { key: "enough", late: true, text: "soon together", shows: judged && speed > 0 ? `in ${seconds(pair.distance / speed, 1)} < ${seconds(decision.ttc_s, 1)}` : `< ${seconds(decision.ttc_s, 1)}`, scale: [judged && speed > 0 ? pair.distance / speed : null, null, decision.ttc_s, 8] },
    ];
  }
  return [...list,
    { key: "closing", late: true, text: `nearer than ${judged ? `${seconds(pair.lookback, 2)} ago` : "before"}${decision.rule === "naive" ? ", cyclist only" : ""}`, shows: approach, scale: [gone, 0, null, 1, -1] },
    { key: "enough", late: true, text: "the cyclist moved", shows: judged ? `${pair.moved.toFixed(3)} > ${metres(decision.min_displacement_m, 3)}` : `> ${metres(decision.min_displacement_m, 3)}`, scale: [judged ? pair.moved : null, decision.min_displacement_m, null, 1.2] },
  ];
}

function showTests(list, rows, decision, side, pair) {
  const wanted = testsOf(decision, side, pair);
  const key = wanted.map((test) => test.key).join();
  if (list.dataset.of !== key) {
    list.dataset.of = key;
    rows.clear();
    list.replaceChildren(...wanted.map((test) => {
      const parts = { mark: el("span", { class: "fl-mark" }), text: el("span", { class: "fl-test" }), shows: el("span", { class: "fl-shows" }), gauge: gauge() };
      rows.set(test.key, parts);
      parts.row = el("li", {}, parts.mark, parts.text, parts.shows, parts.gauge.node);
      return parts.row;
    }));
  }
  for (const test of wanted) {
    const parts = rows.get(test.key);
    const open = !pair || (test.late && !pair.passes.judged);
    const passes = !open && pair.passes[test.key];
    parts.row.className = open ? "open" : passes ? "pass" : "fail";
    setText(parts.mark, open ? "·" : passes ? "✓" : "✕");
    parts.mark.setAttribute("aria-label", open ? "not asked" : passes ? "passes" : "does not pass");
    parts.mark.setAttribute("role", "img");
    setText(parts.text, test.text);
    setText(parts.shows, test.shows);
    parts.gauge.show(open ? null : test.scale[0], ...test.scale.slice(1));
  }
}

const plain = (value) => (value === null || value === undefined ? "–" : value.toFixed(2));

// A line with the stretch that passes and the value on it.
function gauge() {
  const stretch = el("span", { class: "fl-stretch" }), value = el("span", { class: "fl-dot" });
  const node = el("span", { class: "fl-gauge", "aria-hidden": "true" }, stretch, value);
  return {
    node,
    show(at, low, high, most, least = 0) {
      const part = (x) => 100 * Math.min(Math.max((x - least) / (most - least), 0), 1);
      const a = low === null ? 0 : part(low), b = high === null ? 100 : part(high);
      stretch.style.setProperty("left", `${a}%`);
      stretch.style.setProperty("width", `${b - a}%`);
      value.hidden = at === null || at === undefined;
      if (!value.hidden) value.style.setProperty("left", `${part(at)}%`);
    },
  };
}
