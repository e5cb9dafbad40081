// The picture with the grid and the marks: zoom, pan, drag, draw. It has no lens model: all lines come
// from the server, in frame pixels. The centre of pixel (u, v) is at the integers.

import { drawLoupe, drawScene } from "/static/align-paint.js";
import { keepRows } from "/static/align-panels.js";
import { $, canvasOf, el, svg } from "/static/ui.js";

const TAP_PX = 8; // a pointer that moves less taps

export class View {
  // `on`: tap(u, v), moved(mark), chosen(mark), removed(mark), entered(mark)
  constructor(on) {
    Object.assign(this, { stage: $("#stage"), loupe: $("#loupe"), on });
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
    this.paint = canvasOf($("#picture"), (context, width, height) => {
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

  // Shows a picture; zoom and position stay when the size is the same.
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

  // The whole picture on a wide screen, filled on a narrow one, the ground on a phone.
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

  // Part of the picture always stays in view.
  keep() {
    const w = this.size.width * this.scale, h = this.size.height * this.scale;
    this.left = Math.min(Math.max(this.left, 0.5 * this.width - w), 0.5 * this.width);
    this.top = Math.min(Math.max(this.top, 0.5 * this.height - h), 0.5 * this.height);
    this.repaint();
  }

  // Brings a mark into view.
  reveal(mark) {
    const [x, y] = this.toStage(mark.u, mark.v);
    const out = x < 24 || y < 24 || x > this.width - 24 || y > this.height - 24;
    if (out) this.pan(this.width / 2 - x, this.height / 2 - y);
  }

  // --- drawing

  draw(context) {
    if (!this.size || !this.scale) return;
    drawScene(this, context, this.scale, this.left, this.top);
    Object.assign(this.stage.dataset, { scale: this.scale, left: this.left, top: this.top });
  }

  // --- marks: buttons over the picture, so that keyboard and screen reader have them

  setMarks(marks) {
    this.marks = marks;
    keepRows(this.elements, marks, (mark) => {
      const pin = el("button", { type: "button", class: "pin", "data-id": mark.id }, pinShape(), el("span", { class: "tag" }));
      return $("#pins").appendChild(pin);
    });
    for (const mark of marks) {
      const pin = this.elements.get(mark.id);
      pin.setAttribute("aria-label", `Mark ${mark.name}${mark.says ? `, ${mark.says}` : ""}`);
      pin.setAttribute("aria-pressed", String(Boolean(mark.chosen)));
      pin.classList.toggle("off", Boolean(mark.off));
      // On a small screen only the chosen mark shows its reading.
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
    let held = null; // the mark that is dragged
    let still = false; // whether the pointer has not moved yet
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
      const mark = this.markOf(event);
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
        drawLoupe(this, held.mark);
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
      const mark = this.markOf(event);
      if (mark) this.on.chosen(mark);
    });
  }

  // The mark whose button got the event.
  markOf(event) {
    const pin = event.target.closest?.(".pin");
    return pin && this.marks.find((mark) => String(mark.id) === pin.dataset.id);
  }

  key(event) {
    if (!this.size || event.altKey || event.metaKey) return;
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const mark = this.markOf(event);
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
  const shape = "M22 4v13M22 27v13M4 22h13M27 22h13M33 22a11 11 0 1 0-22 0a11 11 0 1 0 22 0";
  return svg("svg", { viewBox: "0 0 44 44", "aria-hidden": "true" }, svg("path", { d: shape, class: "case" }), svg("path", { d: shape, class: "hair" }));
}
