// The plan: agents, trails, cameras, rings, pairs; seen and true. North is up.

import { canvasOf, colour } from "/static/ui.js";
import { NAMES, chosenPair, pairsAt, stateAt, tracksAt } from "/static/testbench-words.js";

const RINGS_M = [5, 10, 15, 20, 25];
const TRAIL_S = 2;

// `where()` gives {play, frame, editing}; `drag` = {pick(x, y, reach), move(handle, x, y), drop()} for
// the editor, in metres.
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

function draw(context, width, height, view, { play, frame, editing, handles }) {
  const px = (x) => width / 2 + (x - view.x) * view.scale;
  const py = (y) => height / 2 - (y - view.y) * view.scale;
  const side = play.sides[0];
  const tone = {
    ink: colour("--ink"), soft: colour("--soft"), line: colour("--line"), panel: colour("--panel"),
    pedestrian: colour("--pedestrian"), cyclist: colour("--cyclist"), vehicle: colour("--vehicle"), sunk: colour("--sunk"),
  };
  context.font = `12px ${colour("--sans")}`;
  context.textBaseline = "middle";
  context.lineJoin = "round";

  context.fillStyle = tone.sunk;
  context.fillRect(0, 0, width, height);
  for (const camera of play.cameras) drawGround(context, px, py, camera);
  drawGrid(context, width, height, view, px, py, tone);
  play.cameras.forEach((camera, i) => drawCamera(context, px, py, camera, view, tone, i, play.cameras.length));

  for (const agent of play.agents) {
    drawPath(context, px, py, agent, tone);
    drawTrail(context, px, py, agent, frame, play.fps, tone);
  }
  const tracks = tracksAt(play, frame);
  const told = drawPairs(context, px, py, play, side, frame, tracks, tone);
  for (const agent of play.agents) drawAgent(context, px, py, agent, frame, view.scale, tone);
  for (const agent of play.agents) drawDetection(context, px, py, agent, frame, tone);
  drawTracks(context, px, py, tracks, tone, told ? [[told.x - 26, told.y - 11, 52, 22]] : []);
  if (told) {
    context.textAlign = "center";
    chip(context, told.text, told.x, told.y, told.fill, told.ink);
  }
  drawScale(context, width, height, view.scale, tone);
  if (editing && handles) drawHandles(context, px, py, handles, tone);
}

// The ground that the camera sees: paper on a darker floor.
function drawGround(context, px, py, camera) {
  const { near, far } = camera;
  const count = near.length / 2;
  context.fillStyle = colour("--seen");
  context.beginPath();
  for (let i = 0; i < count; i++) {
    const j = (i + 1) % count;
    if (near[2 * i] === null || near[2 * j] === null) continue;
    context.moveTo(px(near[2 * i]), py(near[2 * i + 1]));
    context.lineTo(px(far[2 * i]), py(far[2 * i + 1]));
    context.lineTo(px(far[2 * j]), py(far[2 * j + 1]));
    context.lineTo(px(near[2 * j]), py(near[2 * j + 1]));
    context.closePath();
  }
  context.fill();
}

function drawGrid(context, width, height, view, px, py, tone) {
  context.strokeStyle = colour("--grid");
  context.lineWidth = 1;
  context.beginPath();
  const x0 = view.x - width / 2 / view.scale, y0 = view.y - height / 2 / view.scale;
  for (let x = Math.ceil(x0 / 5) * 5; x < x0 + width / view.scale; x += 5) { context.moveTo(Math.round(px(x)) + 0.5, 0); context.lineTo(Math.round(px(x)) + 0.5, height); }
  for (let y = Math.ceil(y0 / 5) * 5; y < y0 + height / view.scale; y += 5) { context.moveTo(0, Math.round(py(y)) + 0.5); context.lineTo(width, Math.round(py(y)) + 0.5); }
  context.stroke();
}

function drawCamera(context, px, py, camera, view, tone, index, count) {
  const x = px(camera.x), y = py(camera.y);
  context.textAlign = "center";
  for (const ring of RINGS_M) {
    context.strokeStyle = ring === 25 ? tone.soft : tone.line;
    context.setLineDash(ring === 25 ? [6, 4] : []);
    context.beginPath();
    context.arc(x, y, ring * view.scale, 0, 7);
    context.stroke();
    context.setLineDash([]);
    if (index === 0) {
      const up = camera.heading_deg * Math.PI / 180;
      const rx = x + Math.cos(up) * ring * view.scale, ry = y - Math.sin(up) * ring * view.scale;
      halo(context, `${ring} m`, rx, ry, tone.soft, tone.panel);
    }
  }
  const turn = -camera.heading_deg * Math.PI / 180;
  context.save();
  context.translate(x, y);
  context.rotate(turn);
  context.fillStyle = tone.ink;
  context.beginPath();
  context.moveTo(15, -8);
  context.lineTo(15, 8);
  context.lineTo(4, 0);
  context.fill();
  context.beginPath();
  context.arc(0, 0, 6, 0, 7);
  context.fill();
  context.restore();
  halo(context, count > 1 ? `camera ${index + 1}` : "camera", x, y + 17, tone.ink, tone.panel);
}

function drawPath(context, px, py, agent, tone) {
  context.strokeStyle = tone[agent.role];
  context.globalAlpha = 0.55;
  context.lineWidth = 1;
  context.setLineDash([1, 4]);
  context.beginPath();
  agent.path.forEach(([, x, y], i) => (i ? context.lineTo(px(x), py(y)) : context.moveTo(px(x), py(y))));
  context.stroke();
  context.setLineDash([]);
  context.globalAlpha = 1;
}

function drawTrail(context, px, py, agent, frame, fps, tone) {
  context.strokeStyle = tone[agent.role];
  context.lineCap = "round";
  const first = Math.max(0, frame - TRAIL_S * fps);
  for (let f = first + 1; f <= frame; f++) {
    const a = 2 * (f - 1), b = 2 * f;
    if (agent.true[a] === null || agent.true[b] === null) continue;
    const part = (f - first) / (frame - first);
    context.globalAlpha = 0.15 + 0.6 * part;
    context.lineWidth = 1 + 2.5 * part;
    context.beginPath();
    context.moveTo(px(agent.true[a]), py(agent.true[a + 1]));
    context.lineTo(px(agent.true[b]), py(agent.true[b + 1]));
    context.stroke();
  }
  context.globalAlpha = 1;
  context.lineCap = "butt";
}

// The true body, to scale (but never too small to see), with its heading.
function drawAgent(context, px, py, agent, frame, scale, tone) {
  const x = agent.true[2 * frame], y = agent.true[2 * frame + 1];
  if (x === null || x === undefined) return;
  const [length, wide] = agent.size_m.map((size) => Math.max(size * scale, 8));
  context.save();
  context.translate(px(x), py(y));
  context.rotate(-agent.heading[frame]);
  context.fillStyle = tone[agent.role];
  context.strokeStyle = tone.panel;
  context.lineWidth = 1.5;
  context.beginPath();
  if (agent.role === "pedestrian") context.arc(0, 0, Math.max(wide, 11) / 2 + 1, 0, 7);
  else context.roundRect(-length / 2, -wide / 2, length, wide, Math.min(wide / 2, 5));
  context.fill();
  context.stroke();
  const tip = (agent.role === "pedestrian" ? 7 : length / 2) + 9;
  context.beginPath();
  context.moveTo(tip, 0);
  context.lineTo(tip - 7, -4.5);
  context.lineTo(tip - 7, 4.5);
  context.fill();
  context.restore();
}

// Where the camera puts somebody: a ring, tied to the true place.
function drawDetection(context, px, py, agent, frame, tone) {
  const x = agent.detected[2 * frame], y = agent.detected[2 * frame + 1];
  if (x === null || x === undefined) {
    if (agent.missed[frame] && agent.true[2 * frame] !== null) {
      const ax = px(agent.true[2 * frame]), ay = py(agent.true[2 * frame + 1]);
      context.strokeStyle = colour("--danger");
      context.lineWidth = 2.5;
      context.beginPath();
      context.moveTo(ax - 9, ay - 9);
      context.lineTo(ax + 9, ay + 9);
      context.moveTo(ax + 9, ay - 9);
      context.lineTo(ax - 9, ay + 9);
      context.stroke();
    }
    return;
  }
  const dx = px(x), dy = py(y);
  context.strokeStyle = tone.ink;
  context.lineWidth = 1;
  if (agent.true[2 * frame] !== null) {
    context.beginPath();
    context.moveTo(px(agent.true[2 * frame]), py(agent.true[2 * frame + 1]));
    context.lineTo(dx, dy);
    context.stroke();
  }
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(dx, dy, 4.5, 0, 7);
  context.stroke();
}

// Names of the tracks, where there is room: the whole name, its number only, or nothing.
function drawTracks(context, px, py, tracks, tone, taken) {
  context.textAlign = "left";
  const free = (box) => taken.every(([x, y, w, h]) => box[0] > x + w || box[0] + box[2] < x || box[1] > y + h || box[1] + box[3] < y);
  for (const track of tracks) {
    const x = px(track.x), y = py(track.y);
    taken.push([x - 7, y - 7, 14, 14]);
  }
  for (const track of tracks) {
    const x = px(track.x), y = py(track.y);
    const tries = [`${track.kind} ${track.id}`, String(track.id)].flatMap((text) => {
      const wide = context.measureText(text).width * 1.1;
      return [[12, -14], [12, 14], [-12 - wide, -14], [-12 - wide, 14]].map(([dx, dy]) => ({ text, at: [x + dx, y + dy], box: [x + dx, y + dy - 7, wide, 14] }));
    });
    const found = tries.find(({ box }) => free(box));
    if (!found) continue;
    taken.push(found.box);
    halo(context, found.text, ...found.at, tone[track.kind], tone.panel, true);
  }
}

// Every pair by a thin line, the one that decides by a strong one; returns its distance's place.
function drawPairs(context, px, py, play, side, frame, tracks, tone) {
  const places = new Map(tracks.map((track) => [track.id, track]));
  const chosen = chosenPair(play, side, frame);
  const line = (pair) => {
    const a = places.get(pair.cyclist), b = places.get(pair.pedestrian);
    if (!a || !b) return null;
    context.beginPath();
    context.moveTo(px(a.x), py(a.y));
    context.lineTo(px(b.x), py(b.y));
    context.stroke();
    return [px((a.x + b.x) / 2), py((a.y + b.y) / 2)];
  };
  for (const pair of pairsAt(play, side, frame)) {
    context.strokeStyle = pair.passes.fires ? colour("--alert") : tone.soft;
    context.lineWidth = pair.passes.fires ? 1.5 : 1;
    context.setLineDash(pair.passes.fires ? [] : [2, 4]);
    line(pair);
  }
  context.setLineDash([]);
  if (!chosen) return null;
  const state = stateAt(side, frame);
  context.strokeStyle = tone.panel;
  context.lineWidth = 7;
  line(chosen);
  context.strokeStyle = colour(`--${state.toLowerCase()}`);
  context.lineWidth = state === "ALERT" ? 4 : 3;
  const middle = line(chosen);
  const name = state.toLowerCase();
  return middle && { text: `${chosen.distance.toFixed(1)} m`, x: middle[0], y: middle[1], fill: colour(`--${name}`), ink: colour(`--on-${name}`) };
}

function drawScale(context, width, height, scale, tone) {
  const long = 5 * scale;
  context.strokeStyle = tone.ink;
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(12, height - 16);
  context.lineTo(12, height - 11);
  context.lineTo(12 + long, height - 11);
  context.lineTo(12 + long, height - 16);
  context.stroke();
  context.textAlign = "left";
  halo(context, "5 m", 17, height - 21, tone.ink, tone.panel);
  context.textAlign = "center";
  halo(context, "N", width - 16, 26, tone.ink, tone.panel);
  context.fillStyle = tone.ink;
  context.beginPath();
  context.moveTo(width - 16, 5);
  context.lineTo(width - 11, 17);
  context.lineTo(width - 21, 17);
  context.fill();
}

function drawHandles(context, px, py, handles, tone) {
  context.textAlign = "left";
  const told = [];
  for (const handle of handles) {
    const x = px(handle.x), y = py(handle.y);
    context.fillStyle = handle.chosen ? tone.ink : tone.panel;
    context.strokeStyle = tone[handle.role];
    context.lineWidth = 2.5;
    context.beginPath();
    context.rect(x - 6, y - 6, 12, 12);
    context.fill();
    context.stroke();
    if (!handle.chosen && told.some(([a, b]) => Math.abs(a - x) < 44 && Math.abs(b - y) < 16)) continue;
    told.push([x, y]);
    halo(context, `${handle.t.toFixed(1)} s`, x + 10, y + 11, tone.ink, tone.panel);
  }
}

function halo(context, text, x, y, ink, paper, strong = false) {
  context.save();
  if (strong) context.font = `600 ${context.font}`;
  context.strokeStyle = paper;
  context.lineWidth = 4;
  context.lineJoin = "round";
  context.strokeText(text, x, y);
  context.fillStyle = ink;
  context.fillText(text, x, y);
  context.restore();
}

function chip(context, text, x, y, fill, ink) {
  context.save();
  context.font = `600 ${context.font}`;
  const half = context.measureText(text).width / 2 + 6;
  context.fillStyle = fill;
  context.beginPath();
  context.roundRect(x - half, y - 10, 2 * half, 20, 10);
  context.fill();
  context.fillStyle = ink;
  context.fillText(text, x, y + 0.5);
  context.restore();
}

// What a screen reader is told of the picture.
export function planWords(play, frame) {
  const side = play.sides[0];
  const words = play.agents.filter((agent) => agent.true[2 * frame] !== null).map((agent) =>
    `${agent.kind} ${agent.id} at ${agent.true[2 * frame].toFixed(1)} east, ${agent.true[2 * frame + 1].toFixed(1)} north`);
  return `Plan view, ${NAMES[side.state[frame]]}. ${words.join("; ") || "nobody is there"}.`;
}
