// The plan view: road users with trails, cameras with rings, pairs; detected and true positions.
// North is up.

import { chip, circle, line, polygon, shape, text, traceLine } from "/static/canvas.js";
import { canvasOf, colour } from "/static/ui.js";
import { NAMES, chosenPair, pairsAt, stateAt, tracksAt } from "/static/testbench-words.js";

const RINGS_M = [5, 10, 15, 20, 25];
const TRAIL_S = 2;
const TONES = ["ink", "soft", "line", "panel", "pedestrian", "cyclist", "vehicle", "sunk"];

// `where()` gives {play, frame, editing, handles}; `drag` = {pick(x, y, reach), move(handle, x, y),
// drop(), add(x, y)} edits paths, in metres.
export function plan(canvas, where, drag = null) {
  let view = null; // {x, y, scale}: the middle in metres, pixels per metre
  let held = null, shown = "";
  const paint = canvasOf(canvas, (context, width, height) => {
    const now = where();
    if (!now.play) return;
    const key = `${now.play.scenario.name} ${width} ${height}`;
    if (!view || key !== shown) { view = fitted(now.play, width, height); shown = key; }
    draw(context, width, height, view, now);
  });
  const metresAt = (event) => {
    const box = canvas.getBoundingClientRect();
    return [
      view.x + (event.clientX - box.left - box.width / 2) / view.scale,
      view.y - (event.clientY - box.top - box.height / 2) / view.scale,
    ];
  };
  if (drag) {
    canvas.addEventListener("pointerdown", (event) => {
      if (!view || !where().editing) return;
      held = drag.pick(...metresAt(event), 14 / view.scale);
      if (held) { canvas.setPointerCapture(event.pointerId); event.preventDefault(); }
    });
    canvas.addEventListener("pointermove", (event) => {
      if (held) drag.move(held, ...metresAt(event));
      else if (view && where().editing) canvas.style.setProperty("cursor", drag.pick(...metresAt(event), 14 / view.scale) ? "grab" : "crosshair");
      else canvas.style.setProperty("cursor", "default");
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { if (held) drag.drop(); held = null; });
    canvas.addEventListener("dblclick", (event) => { if (view && where().editing) drag.add(...metresAt(event)); });
  }
  return { paint, fit() { view = null; paint(); } };
}

function fitted(play, width, height) {
  const xs = [], ys = [];
  for (const agent of play.agents) for (const [, x, y] of agent.path) { xs.push(x); ys.push(y); }
  for (const camera of play.cameras) { xs.push(camera.x); ys.push(camera.y); }
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const scale = Math.min(Math.max(width - 50, 10) / Math.max(x1 - x0, 12), Math.max(height - 50, 10) / Math.max(y1 - y0, 12), 40);
  return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale };
}

// What the drawing functions share: the canvas, its colours, and plan metres to pixels; `place` takes
// the i-th of [x0, y0, x1, y1, ...], or is null where there is none.
function sketchOf(context, width, height, view) {
  const at = (x, y) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];
  const place = (list, i) => (list[2 * i] ?? null) === null ? null : at(list[2 * i], list[2 * i + 1]);
  const tones = Object.fromEntries(TONES.map((name) => [name, colour(`--${name}`)]));
  return { context, width, height, view, scale: view.scale, at, place, tones };
}

function draw(context, width, height, view, { play, frame, editing, handles }) {
  const sketch = sketchOf(context, width, height, view);
  context.font = `12px ${colour("--sans")}`;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.fillStyle = sketch.tones.sunk;
  context.fillRect(0, 0, width, height);
  for (const camera of play.cameras) drawGround(sketch, camera);
  drawGrid(sketch);
  play.cameras.forEach((camera, i) => drawCamera(sketch, camera, i, play.cameras.length));
  for (const agent of play.agents) {
    const path = agent.path.map(([, x, y]) => sketch.at(x, y));
    line(context, path, { stroke: sketch.tones[agent.role], dash: [1, 4], alpha: 0.55 });
    drawTrail(sketch, agent, frame, play.fps);
  }
  const tracks = tracksAt(play, frame);
  const distance = drawPairs(sketch, play, play.sides[0], frame, tracks);
  for (const agent of play.agents) drawAgent(sketch, agent, frame);
  for (const agent of play.agents) drawDetection(sketch, agent, frame);
  drawTracks(sketch, tracks, distance ? [[distance.at[0] - 26, distance.at[1] - 11, 52, 22]] : []);
  if (distance) chip(context, distance.text, distance.at, { ...distance.colours, bold: true });
  drawScale(sketch);
  if (editing && handles) drawHandles(sketch, handles);
}

// The ground that the camera sees: paper on a darker floor.
function drawGround({ context, place }, { near, far }) {
  const count = near.length / 2;
  shape(context, () => {
    for (let i = 0; i < count; i++) {
      const j = (i + 1) % count;
      const corners = [place(near, i), place(far, i), place(far, j), place(near, j)];
      if (!corners[0] || !corners[3]) continue;
      traceLine(context, corners);
      context.closePath();
    }
  }, { fill: colour("--seen") });
}

// A line every 5 m.
function drawGrid({ context, width, height, view, scale, at }) {
  const style = { stroke: colour("--grid") };
  const west = view.x - width / 2 / scale, south = view.y - height / 2 / scale;
  for (let x = Math.ceil(west / 5) * 5; x < west + width / scale; x += 5) {
    const u = Math.round(at(x, 0)[0]) + 0.5;
    line(context, [[u, 0], [u, height]], style);
  }
  for (let y = Math.ceil(south / 5) * 5; y < south + height / scale; y += 5) {
    const v = Math.round(at(0, y)[1]) + 0.5;
    line(context, [[0, v], [width, v]], style);
  }
}

function drawCamera({ context, at, scale, tones }, camera, index, count) {
  const [u, v] = at(camera.x, camera.y);
  const heading = camera.heading_deg * Math.PI / 180;
  for (const ring of RINGS_M) {
    const last = ring === RINGS_M[RINGS_M.length - 1];
    circle(context, [u, v], ring * scale, { stroke: last ? tones.soft : tones.line, dash: last ? [6, 4] : [] });
    if (index > 0) continue;
    const label = at(camera.x + ring * Math.cos(heading), camera.y + ring * Math.sin(heading));
    text(context, `${ring} m`, label, { fill: tones.soft, halo: tones.panel, align: "center" });
  }
  context.save();
  context.translate(u, v);
  context.rotate(-heading);
  polygon(context, [[15, -8], [15, 8], [4, 0]], { fill: tones.ink });
  circle(context, [0, 0], 6, { fill: tones.ink });
  context.restore();
  text(context, count > 1 ? `camera ${index + 1}` : "camera", [u, v + 17], { fill: tones.ink, halo: tones.panel, align: "center" });
}

function drawTrail({ context, place, tones }, agent, frame, fps) {
  context.lineCap = "round";
  const first = Math.max(0, frame - TRAIL_S * fps);
  for (let f = first + 1; f <= frame; f++) {
    const part = (f - first) / (frame - first);
    const ends = [place(agent.true, f - 1), place(agent.true, f)];
    line(context, ends, { stroke: tones[agent.role], width: 1 + 2.5 * part, alpha: 0.15 + 0.6 * part });
  }
  context.lineCap = "butt";
}

// The true body, to scale (but never too small to see), with its heading.
function drawAgent({ context, place, scale, tones }, agent, frame) {
  const at = place(agent.true, frame);
  if (!at) return;
  const [length, wide] = agent.size_m.map((size) => Math.max(size * scale, 8));
  const body = { fill: tones[agent.role], stroke: tones.panel, width: 1.5 };
  const round = agent.role === "pedestrian";
  context.save();
  context.translate(...at);
  context.rotate(-agent.heading[frame]);
  if (round) circle(context, [0, 0], Math.max(wide, 11) / 2 + 1, body);
  else shape(context, () => context.roundRect(-length / 2, -wide / 2, length, wide, Math.min(wide / 2, 5)), body);
  const tip = (round ? 7 : length / 2) + 9;
  polygon(context, [[tip, 0], [tip - 7, -4.5], [tip - 7, 4.5]], { fill: tones[agent.role] });
  context.restore();
}

// A detection: a ring, tied to the true position. A missed agent is crossed out.
function drawDetection({ context, place, tones }, agent, frame) {
  const truth = place(agent.true, frame), detected = place(agent.detected, frame);
  if (detected) {
    line(context, [truth, detected], { stroke: tones.ink });
    circle(context, detected, 4.5, { stroke: tones.ink, width: 1.5 });
  } else if (truth && agent.missed[frame]) {
    const [u, v] = truth;
    const cross = [[u - 9, v - 9], [u + 9, v + 9], null, [u + 9, v - 9], [u - 9, v + 9]];
    line(context, cross, { stroke: colour("--danger"), width: 2.5 });
  }
}

// Names of the tracks, where there is room: the whole name, its number only, or nothing.
function drawTracks({ context, at, tones }, tracks, taken) {
  const free = (box) => taken.every(([x, y, w, h]) => box[0] > x + w || box[0] + box[2] < x || box[1] > y + h || box[1] + box[3] < y);
  const marks = tracks.map((track) => ({ ...track, spot: at(track.x, track.y) }));
  for (const { spot: [u, v] } of marks) taken.push([u - 7, v - 7, 14, 14]);
  for (const { kind, id, spot: [u, v] } of marks) {
    const tries = [`${kind} ${id}`, String(id)].flatMap((words) => {
      const wide = context.measureText(words).width * 1.1;
      return [[12, -14], [12, 14], [-12 - wide, -14], [-12 - wide, 14]].map(([du, dv]) => ({ words, spot: [u + du, v + dv], box: [u + du, v + dv - 7, wide, 14] }));
    });
    const found = tries.find(({ box }) => free(box));
    if (!found) continue;
    taken.push(found.box);
    text(context, found.words, found.spot, { fill: tones[kind], halo: tones.panel, bold: true });
  }
}

// Every pair by a thin line, the one that decides by a strong one; returns its distance's label.
function drawPairs({ context, at, tones }, play, side, frame, tracks) {
  const places = new Map(tracks.map((track) => [track.id, at(track.x, track.y)]));
  const endsOf = (pair) => [places.get(pair.cyclist), places.get(pair.pedestrian)];
  for (const pair of pairsAt(play, side, frame)) {
    line(context, endsOf(pair), pair.passes.fires ? { stroke: colour("--alert"), width: 1.5 } : { stroke: tones.soft, dash: [2, 4] });
  }
  const chosen = chosenPair(play, side, frame);
  const ends = chosen ? endsOf(chosen) : [];
  if (!ends[0] || !ends[1]) return null;
  const state = stateAt(side, frame).toLowerCase();
  const colours = { fill: colour(`--${state}`), ink: colour(`--on-${state}`) };
  line(context, ends, { stroke: tones.panel, width: 7 });
  line(context, ends, { stroke: colours.fill, width: state === "alert" ? 4 : 3 });
  const middle = [0, 1].map((axis) => (ends[0][axis] + ends[1][axis]) / 2);
  return { text: `${chosen.distance.toFixed(1)} m`, at: middle, colours };
}

// A bar of 5 m, and north.
function drawScale({ context, width, height, scale, tones }) {
  const right = 12 + 5 * scale, low = height - 11;
  line(context, [[12, low - 5], [12, low], [right, low], [right, low - 5]], { stroke: tones.ink, width: 1.5 });
  text(context, "5 m", [17, height - 21], { fill: tones.ink, halo: tones.panel });
  text(context, "N", [width - 16, 26], { fill: tones.ink, halo: tones.panel, align: "center" });
  polygon(context, [[width - 16, 5], [width - 11, 17], [width - 21, 17]], { fill: tones.ink });
}

function drawHandles({ context, at, tones }, handles) {
  const labelled = [];
  for (const handle of handles) {
    const [u, v] = at(handle.x, handle.y);
    shape(context, () => context.rect(u - 6, v - 6, 12, 12), { fill: handle.chosen ? tones.ink : tones.panel, stroke: tones[handle.role], width: 2.5 });
    if (!handle.chosen && labelled.some(([a, b]) => Math.abs(a - u) < 44 && Math.abs(b - v) < 16)) continue;
    labelled.push([u, v]);
    text(context, `${handle.t.toFixed(1)} s`, [u + 10, v + 11], { fill: tones.ink, halo: tones.panel });
  }
}

// The plan as a text for screen readers.
export function planWords(play, frame) {
  const side = play.sides[0];
  const words = play.agents.filter((agent) => agent.true[2 * frame] !== null).map((agent) =>
    `${agent.kind} ${agent.id} at ${agent.true[2 * frame].toFixed(1)} east, ${agent.true[2 * frame + 1].toFixed(1)} north`);
  return `Plan view, ${NAMES[side.state[frame]]}. ${words.join("; ") || "no road users"}.`;
}
