// The picture with the grid and the marks: zoom, pan, drag, draw. It knows pixels, no metres and no
// lens: all lines come from the box. Frame pixel (u, v) has its middle at the integer.

import { canvasOf, el, svg } from "/static/ui.js";

export const KINDS = {
  metre: { label: "1 m", colour: "#e6ecf0", width: 0.8, alpha: 0.65 },
  five: { label: "5 m", colour: "#ffffff", width: 1.3, alpha: 0.95 },
  bearing: { label: "Bearings", colour: "#82d7ff", width: 1, alpha: 0.9 },
  ring: { label: "Rings", colour: "#ffd028", width: 2, alpha: 1 },
  horizon: { label: "Horizon", colour: "#ff6ef0", width: 2, alpha: 1 },
  circle: { label: "Lens circle", colour: "#ffffff", width: 1.5, alpha: 0.9 },
};
const TAP_PX = 8; // a finger that moves less has not moved
const LOUPE_PX = 132;

export class View {
  // `on`: tap(u, v), moved(mark), chosen(mark), removed(mark), entered(mark)
  constructor({ stage, canvas, pins, loupe }, on) {
    Object.assign(this, { stage, pins, loupe, on });
    this.levels = [];
    this.size = null;
    this.grid = null;
    this.ten = null;
    this.marks = [];
    this.elements = new Map();
    this.hidden = new Set();
    this.scale = 0;
    this.left = this.top = 0;
    this.width = this.height = 0;
    this.adding = false;
    this.paint = canvasOf(canvas, (context, width, height) => {
      const before = [this.width, this.height];
      [this.width, this.height] = [width, height];
      if (this.size && (before[0] !== width || before[1] !== height)) this.resized(before);
      this.draw(context);
      this.place();
    });
    this.waiting = false;
    this.listen();
  }

  repaint() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.paint();
    });
  }

  // Shows a picture; the view stays where it is when the size is the same.
  async setPicture(blob) {
    const full = await createImageBitmap(blob, { imageOrientation: "none" });
    const levels = [full];
    for (let w = full.width; w > 1000; w = Math.round(w / 2)) {
      const last = levels[levels.length - 1];
      levels.push(await createImageBitmap(last, { resizeWidth: Math.round(last.width / 2), resizeQuality: "medium" }));
    }
    this.levels.forEach((old) => old.close());
    this.levels = levels;
    const same = this.size && this.size.width === full.width && this.size.height === full.height;
    this.size = { width: full.width, height: full.height };
    if (!same) this.start();
    this.repaint();
  }

  setGrid(grid, ten) {
    this.grid = {};
    for (const [kind, lines] of Object.entries(grid.lines)) {
      const path = new Path2D();
      for (const line of lines) {
        for (let i = 0; i < line.length; i += 2) path[i ? "lineTo" : "moveTo"](line[i] + 0.5, line[i + 1] + 0.5);
      }
      this.grid[kind] = path;
    }
    this.labels = grid.labels;
    this.centre = grid.centre;
    this.ten = ten;
    this.repaint();
  }

  // --- zoom and pan

  contain() {
    return Math.min(this.width / this.size.width, this.height / this.size.height);
  }

  // All of it on a wide screen; a narrow one is filled; on a phone the ground is what matters.
  start() {
    if (!this.width) return;
    const fill = Math.max(this.width / this.size.width, this.height / this.size.height);
    const narrow = this.width / this.height < 0.9 * (this.size.width / this.size.height);
    if (this.width >= 640) return this.show(narrow ? fill : this.contain());
    this.show(1.35 * fill);
    this.top = this.height - 0.97 * this.size.height * this.scale;
  }

  show(scale) {
    this.scale = scale;
    this.left = (this.width - this.size.width * scale) / 2;
    this.top = (this.height - this.size.height * scale) / 2;
    this.repaint();
  }

  resized([width, height]) {
    if (!this.scale || !width) return this.start();
    const middle = this.toFrame(width / 2, height / 2);
    this.left = this.width / 2 - (middle[0] + 0.5) * this.scale;
    this.top = this.height / 2 - (middle[1] + 0.5) * this.scale;
    if (this.scale < this.contain()) this.show(this.contain());
  }

  toFrame(x, y) {
    return [(x - this.left) / this.scale - 0.5, (y - this.top) / this.scale - 0.5];
  }

  toStage(u, v) {
    return [(u + 0.5) * this.scale + this.left, (v + 0.5) * this.scale + this.top];
  }

  middle() {
    return this.toFrame(this.width / 2, this.height / 2);
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    if (!this.size) return;
    const scale = Math.min(Math.max(this.scale * factor, 0.9 * this.contain()), 24);
    this.left = x - ((x - this.left) / this.scale) * scale;
    this.top = y - ((y - this.top) / this.scale) * scale;
    this.scale = scale;
    this.keep();
  }

  pan(dx, dy) {
    this.left += dx;
    this.top += dy;
    this.keep();
  }

  // Some of the picture always stays in sight.
  keep() {
    const w = this.size.width * this.scale, h = this.size.height * this.scale;
    this.left = Math.min(Math.max(this.left, 0.5 * this.width - w), 0.5 * this.width);
    this.top = Math.min(Math.max(this.top, 0.5 * this.height - h), 0.5 * this.height);
    this.repaint();
  }

  // Brings a mark into sight.
  reveal(mark) {
    const [x, y] = this.toStage(mark.u, mark.v);
    const out = x < 24 || y < 24 || x > this.width - 24 || y > this.height - 24;
    if (out) this.pan(this.width / 2 - x, this.height / 2 - y);
  }

  // --- drawing

  draw(context) {
    if (!this.size || !this.scale) return;
    this.scene(context, this.scale, this.left, this.top);
    Object.assign(this.stage.dataset, { scale: this.scale, left: this.left, top: this.top });
  }

  scene(context, scale, left, top) {
    const dots = scale * (window.devicePixelRatio || 1);
    const level = Math.min(this.levels.length - 1, Math.max(0, Math.floor(Math.log2(1 / dots))));
    context.imageSmoothingEnabled = scale < 3;
    context.drawImage(this.levels[level], left, top, this.size.width * scale, this.size.height * scale);
    if (!this.grid) return;
    const matrix = new DOMMatrix([scale, 0, 0, scale, left, top]);
    context.lineJoin = context.lineCap = "round";
    const moved = Object.entries(this.grid).map(([kind, path]) => {
      const style = KINDS[kind] ?? { ...KINDS.five, width: 2.4 };
      const shown = new Path2D();
      shown.addPath(path, matrix);
      return { style, shown, hidden: this.hidden.has(kind === "ahead" ? "five" : kind), thin: kind === "metre" };
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
    this.drawLabels(context, at);
    this.drawPoints(context, at);
  }

  drawLabels(context, at) {
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    const taken = [];
    for (const { u, v, text, kind } of this.labels) {
      if (this.hidden.has(kind)) continue;
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

  // The optical centre, what read 10 m before, and where each measurement would lie.
  drawPoints(context, at) {
    const ring = (point, radius, colour) => {
      const [x, y] = at(point);
      for (const [style, width] of [["#0a0d10", 5], [colour, 2.5]]) {
        context.beginPath();
        context.arc(x, y, radius, 0, 7);
        context.strokeStyle = style;
        context.lineWidth = width;
        context.stroke();
      }
    };
    if (this.centre && !this.hidden.has("circle")) {
      const [x, y] = at(this.centre);
      for (const [style, width] of [["#0a0d10", 4], ["#fff", 1.5]]) {
        context.beginPath();
        context.moveTo(x - 7, y); context.lineTo(x + 7, y);
        context.moveTo(x, y - 7); context.lineTo(x, y + 7);
        context.strokeStyle = style;
        context.lineWidth = width;
        context.stroke();
      }
    }
    if (this.ten) ring(this.ten, 9, "#35b5f2");
    for (const mark of this.marks) {
      if (!mark.goal) continue;
      const [x, y] = at([mark.u, mark.v]), [gx, gy] = at(mark.goal);
      for (const [style, width] of [["#0a0d10", 5], ["#ffd028", 2]]) {
        context.beginPath();
        context.moveTo(x, y);
        context.lineTo(gx, gy);
        context.strokeStyle = style;
        context.lineWidth = width;
        context.stroke();
      }
      ring(mark.goal, 4, "#ffd028");
    }
  }

  drawLoupe(mark) {
    const dots = Math.min(window.devicePixelRatio || 1, 3);
    const canvas = this.loupe, scale = Math.max(3 * this.scale, 1);
    canvas.width = canvas.height = LOUPE_PX * dots;
    const context = canvas.getContext("2d");
    context.setTransform(dots, 0, 0, dots, 0, 0);
    const half = LOUPE_PX / 2;
    this.scene(context, scale, half - (mark.u + 0.5) * scale, half - (mark.v + 0.5) * scale);
    for (const [style, width] of [["#0a0d10", 3], ["#ff5a3c", 1]]) {
      context.beginPath();
      for (const [a, b] of [[12, half - 5], [half + 5, LOUPE_PX - 12]]) {
        context.moveTo(a, half); context.lineTo(b, half);
        context.moveTo(half, a); context.lineTo(half, b);
      }
      context.strokeStyle = style;
      context.lineWidth = width;
      context.stroke();
    }
  }

  // --- marks: buttons over the picture, so that keyboard and screen reader have them

  setMarks(marks) {
    this.marks = marks;
    for (const [id, element] of this.elements) {
      if (!marks.some((mark) => mark.id === id)) {
        element.remove();
        this.elements.delete(id);
      }
    }
    for (const mark of marks) {
      if (!this.elements.has(mark.id)) {
        const pin = el("button", { type: "button", class: "pin", "data-id": mark.id }, pinShape(), el("span", { class: "tag" }));
        this.elements.set(mark.id, pin);
        this.pins.append(pin);
      }
      const pin = this.elements.get(mark.id);
      pin.setAttribute("aria-label", `Mark ${mark.name}${mark.says ? `, ${mark.says}` : ""}`);
      pin.setAttribute("aria-pressed", String(Boolean(mark.chosen)));
      pin.classList.toggle("off", Boolean(mark.off));
      // On a small screen only the chosen mark says what it reads.
      pin.lastChild.textContent = mark.chosen || this.width > 640 ? mark.tag ?? mark.name : mark.name;
    }
    this.repaint();
  }

  place() {
    if (!this.scale) return;
    for (const mark of this.marks) {
      const pin = this.elements.get(mark.id);
      if (!pin) continue;
      const [x, y] = this.toStage(mark.u, mark.v);
      pin.hidden = x < -60 || y < -60 || x > this.width + 60 || y > this.height + 60;
      pin.style.transform = `translate(${x.toFixed(2)}px, ${y.toFixed(2)}px)`;
      pin.classList.toggle("left", x > this.width - 90);
    }
  }

  focus(mark) {
    this.elements.get(mark.id)?.focus({ preventScroll: true });
  }

  // --- pointers and keys

  listen() {
    const { stage } = this;
    const fingers = new Map();
    let held = null; // the mark under a finger
    let still = false; // whether the finger may still be tapping
    const point = (event) => {
      const box = stage.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    stage.addEventListener("pointerdown", (event) => {
      if (!this.size || event.button > 0) return;
      const [x, y] = point(event);
      stage.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [x, y]);
      still = fingers.size === 1;
      const pin = event.target.closest?.(".pin");
      const mark = pin && this.marks.find((m) => String(m.id) === pin.dataset.id);
      if (mark && fingers.size === 1) {
        held = { mark, x, y, u: mark.u, v: mark.v, moved: false };
        this.on.chosen(mark);
      } else {
        held = null;
        this.loupe.hidden = true;
      }
      stage.classList.add("dragging");
    });
    stage.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const [x, y] = point(event);
      if (held) {
        if (!held.moved && Math.hypot(x - held.x, y - held.y) < 3) return;
        held.moved = true;
        this.move(held.mark, held.u + (x - held.x) / this.scale, held.v + (y - held.y) / this.scale);
        this.loupe.hidden = false;
        this.loupe.classList.toggle("right", x < this.width / 2);
        this.drawLoupe(held.mark);
        return;
      }
      if (still && Math.hypot(x - last[0], y - last[1]) < TAP_PX) return;
      still = false;
      if (fingers.size === 2) {
        const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
        const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
        const after = Math.hypot(x - other[0], y - other[1]);
        const middle = [(x + other[0]) / 2, (y + other[1]) / 2];
        this.pan((x - last[0]) / 2, (y - last[1]) / 2);
        if (before > 1) this.zoom(after / before, ...middle);
      } else if (fingers.size === 1) {
        this.pan(x - last[0], y - last[1]);
      }
      fingers.set(event.pointerId, [x, y]);
    });
    const up = (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      fingers.delete(event.pointerId);
      if (held) {
        this.loupe.hidden = true;
        this.focus(held.mark);
        held = null;
      } else if (still && event.type === "pointerup" && this.adding) {
        this.on.tap(...this.toFrame(...point(event)));
      }
      still = false;
      if (!fingers.size) stage.classList.remove("dragging");
    };
    stage.addEventListener("pointerup", up);
    stage.addEventListener("pointercancel", up);
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.03 : 0.0015)), ...point(event));
    }, { passive: false });
    stage.addEventListener("keydown", (event) => this.key(event));
    stage.addEventListener("focusin", (event) => {
      const pin = event.target.closest?.(".pin");
      const mark = pin && this.marks.find((m) => String(m.id) === pin.dataset.id);
      if (mark) this.on.chosen(mark);
    });
  }

  key(event) {
    if (!this.size || event.altKey || event.metaKey) return;
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const pin = event.target.closest?.(".pin");
    const mark = pin && this.marks.find((m) => String(m.id) === pin.dataset.id);
    if (way && mark) {
      const step = event.shiftKey ? 10 : event.ctrlKey ? 0.1 : 1;
      this.move(mark, mark.u + way[0] * step, mark.v + way[1] * step);
      this.reveal(mark);
    } else if (way) {
      this.pan(-60 * way[0], -60 * way[1]);
    } else if (mark && (event.key === "Delete" || event.key === "Backspace")) {
      this.on.removed(mark);
    } else if (mark && event.key === "Enter") {
      this.on.entered(mark);
    } else if (event.key === "+" || event.key === "=") {
      this.zoom(1.25);
    } else if (event.key === "-") {
      this.zoom(0.8);
    } else if (event.key === "0") {
      this.show(this.contain());
    } else if (event.key === "m" || event.key === "M") {
      this.on.tap(...this.middle());
    } else {
      return;
    }
    event.preventDefault();
  }

  move(mark, u, v) {
    const tenth = (value) => Math.round(value * 10) / 10;
    mark.u = tenth(Math.min(Math.max(u, 0), this.size.width - 1));
    mark.v = tenth(Math.min(Math.max(v, 0), this.size.height - 1));
    mark.goal = null;
    this.repaint();
    this.on.moved(mark);
  }
}

function pinShape() {
  const cross = "M22 4v13M22 27v13M4 22h13M27 22h13";
  return svg("svg", { viewBox: "0 0 44 44", "aria-hidden": "true" },
    svg("path", { d: cross, class: "case" }), svg("circle", { cx: 22, cy: 22, r: 11, class: "case" }),
    svg("path", { d: cross, class: "hair" }), svg("circle", { cx: 22, cy: 22, r: 11, class: "hair" }));
}
