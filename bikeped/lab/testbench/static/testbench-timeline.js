// The time line: for each decision a band of states, the truth's danger, the distance, marks.

import { canvasOf, colour } from "/static/ui.js";
import { NAMES, configurationName } from "/static/testbench-words.js";

const LEFT = 104, RIGHT = 14, TOP = 18, BAND = 34, GAP = 20, TRUTH = 24, CURVE = 62, AXIS = 22;

// `where()` gives {play, frame}; `seek(frame)` is called while somebody drags.
export function timeline(canvas, where, seek) {
  const paint = canvasOf(canvas, (context, width, height) => draw(context, width, height, where()));
  const host = canvas.parentElement;
  const toFrame = (event) => {
    const { play } = where();
    const box = canvas.getBoundingClientRect();
    const left = box.width < 600 ? 58 : LEFT;
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

export const heightFor = (sides) => TOP + sides * (BAND + GAP) + TRUTH + 8 + CURVE + AXIS;

function draw(context, width, height, { play, frame }) {
  if (!play) return;
  const small = width < 600;
  const left = small ? 58 : LEFT;
  const ink = colour("--ink"), soft = colour("--soft"), line = colour("--line"), panel = colour("--panel");
  const span = play.frames - 1;
  const x = (f) => left + (f / span) * (width - left - RIGHT);
  context.font = `12px ${colour("--sans")}`;
  context.textBaseline = "middle";
  const label = (text, y) => {
    context.fillStyle = soft;
    context.textAlign = "left";
    for (const [i, part] of (small ? [text.split(" ").pop()] : wrap(text, 15)).entries()) context.fillText(part, 0, y + i * 14);
  };

  // whole seconds
  const bottom = height - AXIS;
  const seconds = span / play.fps;
  const every = seconds > 40 ? 5 : seconds > 20 || small ? 2 : 1;
  context.strokeStyle = line;
  context.lineWidth = 1;
  for (let s = 0; s <= seconds; s += every) {
    const at = Math.round(x(s * play.fps)) + 0.5;
    context.beginPath();
    context.moveTo(at, TOP);
    context.lineTo(at, bottom);
    context.stroke();
    context.fillStyle = soft;
    context.textAlign = "center";
    context.fillText(`${s}${s === 0 ? " s" : ""}`, at, bottom + 12);
  }

  let y = TOP;
  for (const side of play.sides) {
    label(configurationName(side.name, true), y + BAND / 2 - (configurationName(side.name, true).length > 15 && !small ? 7 : 0));
    drawStates(context, x, y, side, small);
    drawOnsets(context, x, y, side, play, ink);
    y += BAND + GAP;
  }

  label("danger (truth)", y + TRUTH / 2);
  drawTruth(context, x, y, play, line);
  y += TRUTH + 8;
  label("distance, m", y + 8);
  drawDistance(context, x, y, play, { ink, soft, line, left, right: width - RIGHT });

  // closest approach: a diamond with its line
  if (play.closest_s !== null) {
    const at = x(play.closest_s * play.fps);
    context.strokeStyle = ink;
    context.setLineDash([2, 3]);
    context.beginPath();
    context.moveTo(at, TOP - 4);
    context.lineTo(at, bottom);
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = ink;
    context.beginPath();
    context.moveTo(at, TOP - 14);
    context.lineTo(at + 5, TOP - 8);
    context.lineTo(at, TOP - 2);
    context.lineTo(at - 5, TOP - 8);
    context.fill();
    context.textAlign = at > width - 130 ? "right" : "left";
    context.fillText("closest approach", at + (at > width - 130 ? -9 : 9), TOP - 8);
  }

  // the moment
  const now = x(frame);
  context.strokeStyle = panel;
  context.lineWidth = 5;
  stroke(context, now, TOP - 2, now, bottom + 2);
  context.strokeStyle = ink;
  context.lineWidth = 2;
  stroke(context, now, TOP - 2, now, bottom + 2);
  const text = `${(frame / play.fps).toFixed(2)} s`;
  const half = context.measureText(text).width / 2 + 6;
  const middle = Math.min(Math.max(now, left - 10 + half), width - half);
  context.fillStyle = ink;
  context.beginPath();
  context.roundRect(middle - half, bottom + 3, 2 * half, 18, 4);
  context.fill();
  context.fillStyle = panel;
  context.textAlign = "center";
  context.fillText(text, middle, bottom + 12.5);
}

// States as steps: the higher, the more urgent. Readable without colour.
function drawStates(context, x, y, side, small) {
  for (const { from, to, code } of spans(side.state)) {
    const name = NAMES[code];
    const tall = BAND * [0.3, 0.5, 0.75, 1][code];
    const a = x(Math.max(from - 0.5, 0)), b = x(Math.min(to + 0.5, side.state.length - 1));
    context.fillStyle = colour(`--${name.toLowerCase()}`);
    context.fillRect(a, y + BAND - tall, Math.max(b - a, 1), tall);
    if (tall > 14 && b - a > (small ? 60 : 66)) {
      context.fillStyle = colour(`--on-${name.toLowerCase()}`);
      context.textAlign = "left";
      context.fillText(name, a + 7, y + BAND - tall / 2 + 0.5);
    }
  }
}

// Each onset: a flag, and under the band the time it leaves to the closest approach.
function drawOnsets(context, x, y, side, play, ink) {
  let free = -Infinity;
  for (const onset of side.onsets) {
    const at = x(onset.frame);
    context.fillStyle = ink;
    context.beginPath();
    context.moveTo(at, y + 3);
    context.lineTo(at - 5, y - 6);
    context.lineTo(at + 5, y - 6);
    context.fill();
    if (onset.budget_s === null) continue;
    const end = x(onset.frame + onset.budget_s * play.fps);
    const enough = onset.budget_s > play.prt_s.distracted;
    const tone = enough ? ink : colour("--danger");
    const low = y + BAND + 6;
    if (at < free) continue;
    context.strokeStyle = tone;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(at, low - 3);
    context.lineTo(at, low);
    context.lineTo(Math.max(end, at), low);
    context.lineTo(Math.max(end, at), low - 3);
    context.stroke();
    const text = `${enough ? "✓" : "✕"} ${onset.budget_s.toFixed(2)} s to react`;
    const wide = context.measureText(text).width;
    context.fillStyle = tone;
    context.textAlign = "left";
    const box = Math.min(at + 2, x(play.frames - 1) - wide);
    context.fillStyle = colour("--panel");
    context.fillRect(box - 1, low + 1, wide + 2, 10);
    context.fillStyle = tone;
    context.font = `11px ${colour("--sans")}`;
    context.fillText(text, box, low + 6);
    context.font = `12px ${colour("--sans")}`;
    free = Math.max(end, box + wide) + 8;
  }
}

function drawTruth(context, x, y, play, line) {
  context.strokeStyle = line;
  stroke(context, x(0), y + TRUTH - 0.5, x(play.frames - 1), y + TRUTH - 0.5);
  for (const { from, to, code } of spans(play.truth.tier)) {
    if (!code) continue;
    const a = x(Math.max(from - 0.5, 0)), b = x(Math.min(to + 0.5, play.frames - 1));
    context.fillStyle = colour(code === 1 ? "--actionable" : "--imminent");
    context.fillRect(a, y, Math.max(b - a, 1), TRUTH);
    if (code === 2) hatch(context, a, y, Math.max(b - a, 1), TRUTH);
    const text = code === 1 ? "a warning helps" : "too late";
    if (b - a > context.measureText(text).width + 12) {
      context.fillStyle = colour("--on-danger");
      context.textAlign = "left";
      if (code === 2) {
        context.fillStyle = colour("--imminent");
        context.fillRect(a + 3, y + 3, context.measureText(text).width + 8, TRUTH - 6);
        context.fillStyle = colour("--on-danger");
      }
      context.fillText(text, a + 6, y + TRUTH / 2 + 0.5);
    }
  }
}

function drawDistance(context, x, y, play, { ink, soft, line, left, right }) {
  const values = play.truth.nearest_m;
  const most = Math.min(25, Math.max(10, 5 * Math.ceil(Math.max(...values.filter((v) => v !== null), 0) / 5)));
  const high = CURVE - 6;
  const to = (value) => y + high - Math.min(value, most) / most * high;
  const decision = play.sides[0].decision;
  context.fillStyle = colour("--band");
  context.fillRect(left, to(decision.d_max_m), right - left, Math.max(to(decision.d_min_m) - to(decision.d_max_m), 0));
  context.fillStyle = soft;
  context.textAlign = "right";
  for (const value of most > 15 ? [0, 10, 20] : [0, 5, 10]) {
    context.fillText(String(value), left - 6, to(value));
    context.strokeStyle = line;
    stroke(context, left, Math.round(to(value)) + 0.5, right, Math.round(to(value)) + 0.5);
  }
  const curve = (list, style, wide, dash) => {
    context.strokeStyle = style;
    context.lineWidth = wide;
    context.setLineDash(dash);
    context.beginPath();
    let open = false;
    list.forEach((value, f) => {
      if (value === null || value > most) { open = false; return; }
      if (open) context.lineTo(x(f), to(value));
      else context.moveTo(x(f), to(value));
      open = true;
    });
    context.stroke();
    context.setLineDash([]);
  };
  curve(measured(play), colour("--accent"), 1.5, []);
  curve(values, ink, 1.5, [5, 3]);
}

// The distance that the rule saw of the pair it decided about.
function measured(play) {
  const side = play.sides[0];
  return side.chosen.map((at) => (at < 0 ? null : side.pairs.distance_m[at]));
}

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
  context.save();
  context.beginPath();
  context.rect(x, y, width, height);
  context.clip();
  context.strokeStyle = colour("--panel");
  context.lineWidth = 1.5;
  context.beginPath();
  for (let at = x - height; at < x + width; at += 7) {
    context.moveTo(at, y + height);
    context.lineTo(at + height, y);
  }
  context.stroke();
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

function stroke(context, x1, y1, x2, y2) {
  context.beginPath();
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
  context.stroke();
}
