// Draws the picture, the grid and the marks' measured positions, at any scale: for stage and loupe.

import { circle, line } from "/static/canvas.js";

export const KINDS = {
  metre: { label: "1 m", colour: "#e6ecf0", width: 0.8, alpha: 0.65 },
  five: { label: "5 m", colour: "#ffffff", width: 1.3, alpha: 0.95 },
  bearing: { label: "Bearings", colour: "#82d7ff", width: 1, alpha: 0.9 },
  ring: { label: "Rings", colour: "#ffd028", width: 2, alpha: 1 },
  horizon: { label: "Horizon", colour: "#ff6ef0", width: 2, alpha: 1 },
  circle: { label: "Lens circle", colour: "#ffffff", width: 1.5, alpha: 0.9 },
};
const LOUPE_PX = 132;
const DARK = "#0a0d10";

// The picture with its top left corner at (left, top), `scale` screen pixels to one of its own.
export function drawScene(view, context, scale, left, top) {
  const dots = scale * (window.devicePixelRatio || 1);
  const level = Math.min(view.levels.length - 1, Math.max(0, Math.floor(Math.log2(1 / dots))));
  context.imageSmoothingEnabled = scale < 3;
  context.drawImage(view.levels[level], left, top, view.size.width * scale, view.size.height * scale);
  if (!view.grid) return;
  const matrix = new DOMMatrix([scale, 0, 0, scale, left, top]);
  context.lineJoin = context.lineCap = "round";
  const moved = Object.entries(view.grid).map(([kind, path]) => {
    const style = KINDS[kind] ?? { ...KINDS.five, width: 2.4 };
    const shown = new Path2D();
    shown.addPath(path, matrix);
    return { style, shown, hidden: view.hidden.has(kind === "ahead" ? "five" : kind), thin: kind === "metre" };
  }).filter((item) => !item.hidden);
  context.strokeStyle = "rgb(8 11 14 / 55%)";
  for (const { style, shown, thin } of moved) {
    context.lineWidth = style.width + (thin ? 1 : 2);
    context.globalAlpha = thin ? 0.5 : 1;
    context.stroke(shown);
  }
  for (const { style, shown } of moved) {
    context.globalAlpha = style.alpha;
    context.strokeStyle = style.colour;
    context.lineWidth = style.width;
    context.stroke(shown);
  }
  context.globalAlpha = 1;
  const at = ([u, v]) => [(u + 0.5) * scale + left, (v + 0.5) * scale + top];
  drawLabels(view, context, at);
  drawPoints(view, context, at);
}

function drawLabels(view, context, at) {
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const taken = [];
  for (const { u, v, text, kind } of view.labels) {
    if (view.hidden.has(kind)) continue;
    const [x, y0] = at([u, v]);
    const y = kind === "horizon" ? y0 - 13 : y0;
    const half = context.measureText(text).width / 2 + 4;
    const box = [x - half, y - 9, x + half, y + 9];
    if (taken.some((b) => box[0] < b[2] && b[0] < box[2] && box[1] < b[3] && b[1] < box[3])) continue;
    taken.push(box);
    context.fillStyle = "rgb(8 11 14 / 72%)";
    context.fillRect(box[0], box[1], 2 * half, 18);
    context.fillStyle = KINDS[kind].colour;
    context.fillText(text, x, y + 0.5);
  }
}

// The optical centre, the pixel that read 10 m before, and the measured position of each mark.
function drawPoints(view, context, at) {
  const ring = (point, radius, colour) => {
    circle(context, at(point), radius, { stroke: DARK, width: 5 });
    circle(context, at(point), radius, { stroke: colour, width: 2.5 });
  };
  if (view.centre && !view.hidden.has("circle")) {
    const [x, y] = at(view.centre);
    outlined(context, [[x - 7, y], [x + 7, y], null, [x, y - 7], [x, y + 7]], [4, DARK], [1.5, "#fff"]);
  }
  if (view.ten) ring(view.ten, 9, "#35b5f2");
  for (const mark of view.marks) {
    if (!mark.goal) continue;
    outlined(context, [at([mark.u, mark.v]), at(mark.goal)], [5, DARK], [2, "#ffd028"]);
    ring(mark.goal, 4, "#ffd028");
  }
}

// A line in each of [width, colour], one over the other.
function outlined(context, points, ...styles) {
  for (const [width, stroke] of styles) line(context, points, { stroke, width });
}

// The picture around a mark, enlarged, with a cross at the mark.
export function drawLoupe(view, mark) {
  const dots = Math.min(window.devicePixelRatio || 1, 3);
  const canvas = view.loupe, scale = Math.max(3 * view.scale, 1);
  canvas.width = canvas.height = LOUPE_PX * dots;
  const context = canvas.getContext("2d");
  context.setTransform(dots, 0, 0, dots, 0, 0);
  const half = LOUPE_PX / 2;
  drawScene(view, context, scale, half - (mark.u + 0.5) * scale, half - (mark.v + 0.5) * scale);
  const arms = [[12, half - 5], [half + 5, LOUPE_PX - 12]];
  const cross = arms.flatMap(([a, b]) => [[a, half], [b, half], null, [half, a], [half, b], null]);
  outlined(context, cross, [3, DARK], [1, "#ff5a3c"]);
}
