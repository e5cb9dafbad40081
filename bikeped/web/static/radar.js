// The plan view: the camera at the bottom centre, forward up, rings every 5 m. Between two messages
// the marks move with their velocity; a message's correction is blended in over a tenth of a second.

import { chip, circle, line, polygon, shape, text } from "/static/canvas.js";
import { calm, canvasOf, colour, metres } from "/static/ui.js";

const BEHIND = 0.2;      // share of the range that is shown behind the camera
const AHEAD_S = 0.3;     // longest extrapolation
const SETTLE_S = 0.1;
const TRAIL = 60;        // positions kept of each road user

export class Radar {
  constructor(canvas) {
    this.canvas = canvas;
    this.range = 25;
    this.fov = Math.PI;
    this.heading = 0;
    this.marks = new Map();
    this.pair = null;
    this.alerting = false;
    this.live = false;
    this.frame = null;
    this.paint = canvasOf(canvas, (context, width, height) => this.draw(context, width, height));
  }

  describe({ range_m, fov_rad, heading_deg }) {
    // Tracks may be kept farther than the rules reach; farther rings would only shrink the plan.
    this.range = Math.min(range_m, 30);
    this.fov = fov_rad;
    this.heading = heading_deg * Math.PI / 180;
    this.paint();
  }

  // A message's tracks: [{id, kind, x, y, vx, vy, unseen_s}], and the deciding pair.
  show(tracks, pair, alerting) {
    const at = performance.now() / 1000;
    const present = new Set();
    for (const track of tracks) {
      present.add(track.id);
      const mark = this.marks.get(track.id) ?? { trail: [], dx: 0, dy: 0, at };
      if (mark.x !== undefined && !calm()) {
        const [x, y] = this.place(mark, at);
        mark.dx = x - track.x;
        mark.dy = y - track.y;
        if (Math.hypot(mark.dx, mark.dy) > 3) mark.dx = mark.dy = 0;
      }
      Object.assign(mark, track, { at });
      const last = mark.trail[mark.trail.length - 1];
      if (!last || Math.hypot(last[0] - track.x, last[1] - track.y) > 0.1) mark.trail.push([track.x, track.y]);
      if (mark.trail.length > TRAIL) mark.trail.shift();
      this.marks.set(track.id, mark);
    }
    for (const id of this.marks.keys()) if (!present.has(id)) this.marks.delete(id);
    this.pair = pair;
    this.alerting = alerting;
    if (calm()) this.paint();
    else this.run();
  }

  // Whether messages come: without them nothing moves.
  setLive(live) {
    this.live = live;
    if (live) this.run();
  }

  run() {
    if (this.frame !== null || !this.live || calm()) return;
    const step = () => {
      this.frame = null;
      this.paint();
      if (this.live && this.marks.size && !document.hidden) this.frame = requestAnimationFrame(step);
    };
    this.frame = requestAnimationFrame(step);
  }

  place(mark, at) {
    if (calm()) return [mark.x, mark.y];
    const since = at - mark.at;
    const on = this.live ? Math.min(since, AHEAD_S) : 0;
    const left = Math.exp(-since / SETTLE_S);
    return [mark.x + mark.vx * on + mark.dx * left, mark.y + mark.vy * on + mark.dy * left];
  }

  draw(context, width, height) {
    const margin = 10;
    const scale = Math.min((width - 2 * margin) / (2 * this.range), (height - 2 * margin) / (this.range * (1 + BEHIND)));
    const u0 = width / 2;
    const v0 = (height - scale * this.range * (1 + BEHIND)) / 2 + scale * this.range;
    const px = ([x, y]) => [u0 + scale * y, v0 - scale * x];
    context.font = `600 12px ${colour("--sans")}`;
    context.textBaseline = "middle";
    this.drawGround(context, width, px, scale);
    const at = performance.now() / 1000;
    const places = new Map([...this.marks].map(([id, mark]) => [id, this.place(mark, at)]));
    for (const mark of this.marks.values()) this.drawTrail(context, mark, px);
    this.drawPair(context, places, px);
    for (const [id, mark] of this.marks) this.drawArrow(context, mark, places.get(id), px);
    for (const [id, mark] of this.marks) this.drawMark(context, mark, places.get(id), px, width, height);
  }

  // The field of view with bearings every 30 degrees and range rings, and the camera.
  drawGround(context, width, px, scale) {
    const [u0, v0] = px([0, 0]);
    const r = scale * this.range;
    context.save();
    context.beginPath();
    context.rect(0, 0, width, v0 + r * BEHIND + 4);
    context.clip();
    const fov = Math.min(this.fov, 2 * Math.PI);
    const from = -Math.PI / 2 + this.heading - fov / 2;
    shape(context, () => {
      context.moveTo(u0, v0);
      context.arc(u0, v0, r, from, from + fov);
    }, { fill: colour("--sunk") });
    for (let degrees = -90; degrees <= 90; degrees += 30) {
      const a = degrees * Math.PI / 180;
      line(context, [[u0, v0], [u0 + r * Math.sin(a), v0 - r * Math.cos(a)]], { stroke: colour("--line") });
    }
    const step = this.range > 15 ? 5 : 2;
    const rings = Array.from({ length: Math.floor((this.range + 1e-6) / step) }, (_, i) => (i + 1) * step);
    for (const ring of rings) {
      circle(context, [u0, v0], scale * ring, { stroke: colour(ring % 10 === 0 ? "--line-strong" : "--line") });
    }
    context.restore();
    context.save();
    context.font = `12px ${colour("--sans")}`;
    const label = 15 * Math.PI / 180; // the bearing of the rings' labels
    for (const ring of rings) {
      const spot = px([ring * Math.cos(label), ring * Math.sin(label)]);
      chip(context, `${ring} m`, spot, { fill: colour("--sunk"), ink: colour("--soft"), height: 16, radius: 0 });
    }
    context.translate(u0, v0);
    context.rotate(this.heading);
    polygon(context, [[-7, 8], [7, 8], [4, -5], [-4, -5]], { fill: colour("--ink") });
    context.restore();
  }

  drawTrail(context, { trail, kind }, px) {
    for (let i = 1; i < trail.length; i++) {
      const ends = [px(trail[i - 1]), px(trail[i])];
      line(context, ends, { stroke: colour(`--${kind}`), width: 2, alpha: 0.08 + 0.42 * i / trail.length });
    }
  }

  drawPair(context, places, px) {
    const ends = this.pair && [places.get(this.pair.cyclist), places.get(this.pair.pedestrian)];
    if (!ends || !ends[0] || !ends[1]) return;
    const [a, b] = ends.map(px);
    const tone = this.alerting ? "alert" : "warning";
    const fill = colour(`--${tone}`);
    line(context, [a, b], { stroke: fill, width: this.alerting ? 4 : 2.5, dash: this.alerting ? [] : [7, 5] });
    const distance = metres(this.pair.distance_m);
    if (Math.hypot(b[0] - a[0], b[1] - a[1]) < context.measureText(distance).width + 52) return;
    const middle = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    chip(context, distance, middle, { fill, ink: colour(`--on-${tone}`), height: 22, radius: 3 });
  }

  // An arrow to the position in one second.
  drawArrow(context, mark, [x, y], px) {
    if (Math.hypot(mark.vx, mark.vy) < 0.3 || Math.hypot(x, y) > this.range) return;
    line(context, [px([x, y]), px([x + mark.vx, y + mark.vy])], { stroke: colour(`--${mark.kind}`), width: 2 });
  }

  // A road user; beyond the range at its edge, while it is not detected in outline.
  drawMark(context, mark, [x, y], px, width, height) {
    const far = Math.hypot(x, y) > this.range;
    const k = far ? this.range / Math.hypot(x, y) : 1;
    const [u, v] = px([x * k, y * k]);
    if (v > height - 6) return;
    const ink = colour(`--${mark.kind}`), panel = colour("--panel");
    const [fill, stroke] = mark.unseen_s > 0 ? [panel, ink] : [ink, panel];
    const style = { fill, stroke, width: 2, alpha: far ? 0.6 : 1 };
    context.save();
    context.translate(u, v);
    if (Math.hypot(mark.vx, mark.vy) > 0.3) context.rotate(Math.atan2(mark.vy, mark.vx));
    if (mark.kind === "pedestrian") circle(context, [0, 0], 7, style);
    else if (mark.kind === "cyclist") polygon(context, [[0, -11], [8, 8], [0, 4], [-8, 8]], style);
    else shape(context, () => context.rect(-7, -7, 14, 14), style);
    context.restore();
    if (!far) text(context, String(mark.id), [Math.min(u + 11, width - 20), v - 11], { fill: ink, halo: colour("--sunk") });
  }
}
