// The time line: for each decision a band of states, then the ground truth and the distance. And a
// scenario as a strip: danger above, states below; the higher, the more urgent.

import { chip, line, polygon, text } from "/static/canvas.js";
import { canvasOf, colour } from "/static/ui.js";
import { NAMES, configurationName } from "/static/testbench-words.js";

const LEFT = 104, LEFT_SMALL = 58, SMALL_PX = 600, RIGHT = 14, TOP = 18, BAND = 34, GAP = 20, TRUTH = 24, CURVE = 62, AXIS = 22;

// `where()` gives {play, frame}; `seek(frame)` is called while the pointer drags.
export function timeline(canvas, where, seek) {
  const paint = canvasOf(canvas, (context, width, height) => draw(context, width, height, where()));
  const host = canvas.parentElement;
  const toFrame = (event) => {
    const { play } = where();
    const box = canvas.getBoundingClientRect();
    const left = box.width < SMALL_PX ? LEFT_SMALL : LEFT;
    const part = (event.clientX - box.left - left) / (box.width - left - RIGHT);
    return Math.round(Math.min(Math.max(part, 0), 1) * (play.frames - 1));
  };
  host.addEventListener("pointerdown", (event) => {
    if (!where().play || event.button > 0) return;
    host.setPointerCapture(event.pointerId);
    host.focus({ preventScroll: true });
    seek(toFrame(event));
  });
  host.addEventListener("pointermove", (event) => {
    if (host.hasPointerCapture(event.pointerId)) seek(toFrame(event));
  });
  return {
    paint,
    fit(sides) {
      canvas.style.setProperty("height", `${heightFor(sides)}px`);
      paint();
    },
  };
}

const heightFor = (sides) => TOP + sides * (BAND + GAP) + TRUTH + 8 + CURVE + AXIS;

function draw(context, width, height, { play, frame }) {
  if (!play) return;
  const small = width < SMALL_PX;
  const left = small ? LEFT_SMALL : LEFT;
  const [ink, soft, grey, panel] = ["--ink", "--soft", "--line", "--panel"].map(colour);
  const span = play.frames - 1;
  const x = (f) => left + (f / span) * (width - left - RIGHT);
  context.font = `12px ${colour("--sans")}`;
  context.textBaseline = "middle";
  const label = (words, y) => {
    const parts = small ? [words.split(" ").pop()] : wrap(words, 15);
    parts.forEach((part, i) => text(context, part, [0, y + i * 14], { fill: soft }));
  };

  // whole seconds
  const bottom = height - AXIS;
  const seconds = span / play.fps;
  const every = seconds > 40 ? 5 : seconds > 20 || small ? 2 : 1;
  for (let s = 0; s <= seconds; s += every) {
    const at = Math.round(x(s * play.fps)) + 0.5;
    line(context, [[at, TOP], [at, bottom]], { stroke: grey });
    text(context, `${s}${s === 0 ? " s" : ""}`, [at, bottom + 12], { fill: soft, align: "center" });
  }

  let y = TOP;
  for (const side of play.sides) {
    const name = configurationName(side.name, true);
    label(name, y + BAND / 2 - (name.length > 15 && !small ? 7 : 0));
    drawStates(context, x, y, side, small);
    drawOnsets(context, x, y, side, play, ink);
    y += BAND + GAP;
  }

  label("danger (truth)", y + TRUTH / 2);
  drawTruth(context, x, y, play, grey);
  y += TRUTH + 8;
  label("distance, m", y + 8);
  drawDistance(context, x, y, play, { ink, soft, grey, left, right: width - RIGHT });

  // closest approach: a diamond with its line
  if (play.closest_s !== null) {
    const at = x(play.closest_s * play.fps);
    const side = at > width - 130 ? -9 : 9;
    line(context, [[at, TOP - 4], [at, bottom]], { stroke: ink, width: 1.5, dash: [2, 3] });
    polygon(context, [[at, TOP - 14], [at + 5, TOP - 8], [at, TOP - 2], [at - 5, TOP - 8]], { fill: ink });
    text(context, "closest approach", [at + side, TOP - 8], { fill: ink, align: side < 0 ? "right" : "left" });
  }

  // the frame shown
  const cursor = [[x(frame), TOP - 2], [x(frame), bottom + 2]];
  line(context, cursor, { stroke: panel, width: 5 });
  line(context, cursor, { stroke: ink, width: 2 });
  const time = `${(frame / play.fps).toFixed(2)} s`;
  const half = context.measureText(time).width / 2 + 6;
  const middle = Math.min(Math.max(x(frame), left - 10 + half), width - half);
  chip(context, time, [middle, bottom + 12], { fill: ink, ink: panel, height: 18, radius: 4 });
}

// Runs of equal codes as [code, start, width] in pixels, each half a frame longer on both sides.
function segments(codes, x) {
  return spans(codes).map(({ from, to, code }) => {
    const start = x(Math.max(from - 0.5, 0));
    return [code, start, Math.max(x(Math.min(to + 0.5, codes.length - 1)) - start, 1)];
  });
}

// States as steps: the higher, the more urgent. Readable without colour.
function drawStates(context, x, y, side, small) {
  for (const [code, start, wide] of segments(side.state, x)) {
    const name = NAMES[code];
    const tall = BAND * [0.3, 0.5, 0.75, 1][code];
    context.fillStyle = colour(`--${name.toLowerCase()}`);
    context.fillRect(start, y + BAND - tall, wide, tall);
    if (tall > 14 && wide > (small ? 60 : 66)) {
      text(context, name, [start + 7, y + BAND - tall / 2 + 0.5], { fill: colour(`--on-${name.toLowerCase()}`) });
    }
  }
}

// Each onset: a flag, and under the band the time it leaves to the closest approach.
function drawOnsets(context, x, y, side, play, ink) {
  let free = -Infinity;
  for (const onset of side.onsets) {
    const at = x(onset.frame);
    polygon(context, [[at, y + 3], [at - 5, y - 6], [at + 5, y - 6]], { fill: ink });
    if (onset.budget_s === null || at < free) continue;
    const end = Math.max(x(onset.frame + onset.budget_s * play.fps), at);
    const enough = onset.budget_s > play.prt_s.distracted;
    const tone = enough ? ink : colour("--danger");
    const low = y + BAND + 6;
    line(context, [[at, low - 3], [at, low], [end, low], [end, low - 3]], { stroke: tone, width: 1.5 });
    const words = `${enough ? "✓" : "✕"} ${onset.budget_s.toFixed(2)} s to react`;
    const wide = context.measureText(words).width;
    const start = Math.min(at + 2, x(play.frames - 1) - wide);
    context.save();
    context.font = `11px ${colour("--sans")}`;
    context.fillStyle = colour("--panel");
    context.fillRect(start - 1, low + 1, wide + 2, 10);
    text(context, words, [start, low + 6], { fill: tone });
    context.restore();
    free = Math.max(end, start + wide) + 8;
  }
}

function drawTruth(context, x, y, play, grey) {
  line(context, [[x(0), y + TRUTH - 0.5], [x(play.frames - 1), y + TRUTH - 0.5]], { stroke: grey });
  for (const [code, start, wide] of segments(play.truth.tier, x)) {
    if (!code) continue;
    const late = code === 2;
    const words = late ? "too late" : "a warning helps";
    const needed = context.measureText(words).width;
    context.fillStyle = colour(late ? "--imminent" : "--actionable");
    context.fillRect(start, y, wide, TRUTH);
    if (late) hatch(context, start, y, wide, TRUTH);
    if (wide <= needed + 12) continue;
    if (late) context.fillRect(start + 3, y + 3, needed + 8, TRUTH - 6);
    text(context, words, [start + 6, y + TRUTH / 2 + 0.5], { fill: colour("--on-danger") });
  }
}

function drawDistance(context, x, y, play, { ink, soft, grey, left, right }) {
  const values = play.truth.nearest_m;
  const most = Math.min(25, Math.max(10, 5 * Math.ceil(Math.max(...values.filter((v) => v !== null), 0) / 5)));
  const high = CURVE - 6;
  const to = (value) => y + high - Math.min(value, most) / most * high;
  const side = play.sides[0];
  const band = [side.decision.d_max_m, side.decision.d_min_m].map(to);
  context.fillStyle = colour("--band");
  context.fillRect(left, band[0], right - left, Math.max(band[1] - band[0], 0));
  for (const value of most > 15 ? [0, 10, 20] : [0, 5, 10]) {
    const level = Math.round(to(value)) + 0.5;
    text(context, String(value), [left - 6, to(value)], { fill: soft, align: "right" });
    line(context, [[left, level], [right, level]], { stroke: grey });
  }
  const points = (list) => list.map((value, f) => (value === null || value > most ? null : [x(f), to(value)]));
  // the distance that the rule measured of its pair, and the true one
  const measured = side.chosen.map((at) => (at < 0 ? null : side.pairs.distance_m[at]));
  line(context, points(measured), { stroke: colour("--accent"), width: 1.5 });
  line(context, points(values), { stroke: ink, width: 1.5, dash: [5, 3] });
}

// Runs of equal codes: {from, to, code}, both ends within.
export function spans(codes) {
  const found = [];
  for (let i = 0; i < codes.length; i++) {
    const last = found[found.length - 1];
    if (last && last.code === codes[i]) last.to = i;
    else found.push({ from: i, to: i, code: codes[i] });
  }
  return found;
}

function hatch(context, x, y, width, height) {
  const lines = [];
  for (let at = x - height; at < x + width; at += 7) lines.push([at, y + height], [at + height, y], null);
  context.save();
  context.beginPath();
  context.rect(x, y, width, height);
  context.clip();
  line(context, lines, { stroke: colour("--panel"), width: 1.5 });
  context.restore();
}

function wrap(text, most) {
  const lines = [""];
  for (const word of text.split(" ")) {
    const last = lines[lines.length - 1];
    if (last && (last + word).length >= most) lines.push(word);
    else lines[lines.length - 1] = last ? `${last} ${word}` : word;
  }
  return lines;
}

// The strip in words.
export function stripWords(strip, entry) {
  const total = strip.frames;
  const share = (runs, code) => Math.round(100 * runs.filter(([c]) => c === code).reduce((sum, [, n]) => sum + n, 0) / total);
  return `${strip.name}: alert ${share(strip.after, 3)} % of the time${strip.before ? `, before ${share(strip.before, 3)} %` : ""}; danger ${share(strip.truth, 1) + share(strip.truth, 2)} %${entry ? "; changed" : ""}`;
}

export function drawStrip(context, width, height, strip, both) {
  const x = (f) => f / strip.frames * width;
  const lane = (runs, top, tall, heights, paint, alpha = 1) => {
    let at = 0;
    context.globalAlpha = alpha;
    for (const [code, count] of runs) {
      const part = heights[code];
      context.fillStyle = paint(code);
      if (part) context.fillRect(x(at), top + tall * (1 - part), Math.max(x(at + count) - x(at), 0.75), tall * part);
      at += count;
    }
    context.globalAlpha = 1;
  };
  const state = (code) => colour(`--${NAMES[code].toLowerCase()}`);
  const steps = [0.2, 0.4, 0.65, 1];
  lane(strip.truth, 0, 5, [0, 1, 1], (code) => colour(code === 1 ? "--actionable" : "--imminent"));
  context.fillStyle = colour("--line");
  context.fillRect(0, 5, width, 1);
  if (both && strip.before) {
    const tall = (height - 9) / 2;
    lane(strip.before, 7, tall, steps, state, 0.45);
    lane(strip.after, 9 + tall, tall, steps, state);
  } else lane(strip.after, 7, height - 7, steps, state);
}
