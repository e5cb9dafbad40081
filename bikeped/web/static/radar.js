// The plan view: the camera low in the middle, forward up, rings every 5 m. Between two messages the
// marks move on with their speed, and what a message corrects is taken up within a tenth of a second.

import { calm, canvasOf, colour, metres } from "/static/ui.js";

const BEHIND = 0.2;      // share of the range that is shown behind the camera
const AHEAD_S = 0.3;     // marks are moved on for so long at most
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
    // Where tracks are kept further than the rules look, rings to the horizon would help nobody.
    this.range = Math.min(range_m, 30);
    this.fov = fov_rad;
    this.heading = heading_deg * Math.PI / 180;
    this.paint();
  }

  // A message's tracks: [{id, kind, x, y, vx, vy, unseen_s}], and the pair that was judged.
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
    const px = (x, y) => [u0 + scale * y, v0 - scale * x];
    this.drawGround(context, width, height, px, scale);
    const at = performance.now() / 1000;
    const places = new Map([...this.marks].map(([id, mark]) => [id, this.place(mark, at)]));
    for (const mark of this.marks.values()) this.drawTrail(context, mark, px);
    this.drawPair(context, places, px);
    for (const [id, mark] of this.marks) this.drawArrow(context, mark, places.get(id), px);
    for (const [id, mark] of this.marks) this.drawMark(context, mark, places.get(id), px, width, height);
  }

  drawGround(context, width, height, px, scale) {
    const [u0, v0] = px(0, 0);
    const r = scale * this.range;
    const floor = v0 + r * BEHIND + 4;
    context.save();
    context.beginPath();
    context.rect(0, 0, width, floor);
    context.clip();
    const from = -Math.PI / 2 + this.heading - Math.min(this.fov, 2 * Math.PI) / 2;
    const to = from + Math.min(this.fov, 2 * Math.PI);
    context.fillStyle = colour("--sunk");
    context.beginPath();
    context.moveTo(u0, v0);
    context.arc(u0, v0, r, from, to);
    context.closePath();
    context.fill();
    context.strokeStyle = colour("--line");
    context.lineWidth = 1;
    for (let degrees = -90; degrees <= 90; degrees += 30) {
      const a = degrees * Math.PI / 180;
      context.beginPath();
      context.moveTo(u0, v0);
      context.lineTo(u0 + r * Math.sin(a), v0 - r * Math.cos(a));
      context.stroke();
    }
    const step = this.range > 15 ? 5 : 2;
    for (let ring = step; ring <= this.range + 1e-6; ring += step) {
      context.strokeStyle = colour(ring % 10 === 0 ? "--line-strong" : "--line");
      context.beginPath();
      context.arc(u0, v0, scale * ring, 0, 2 * Math.PI);
      context.stroke();
    }
    context.restore();
    context.font = `12px ${getComputedStyle(document.body).fontFamily}`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (let ring = step; ring <= this.range + 1e-6; ring += step) {
      const a = 15 * Math.PI / 180;
      const [u, v] = px(ring * Math.cos(a), ring * Math.sin(a));
      const word = `${ring} m`;
      const wide = context.measureText(word).width + 6;
      context.fillStyle = colour("--sunk");
      context.fillRect(u - wide / 2, v - 8, wide, 16);
      context.fillStyle = colour("--soft");
      context.fillText(word, u, v);
    }
    context.fillStyle = colour("--ink");
    context.save();
    context.translate(u0, v0);
    context.rotate(this.heading);
    context.beginPath();
    context.moveTo(-7, 8);
    context.lineTo(7, 8);
    context.lineTo(4, -5);
    context.lineTo(-4, -5);
    context.closePath();
    context.fill();
    context.restore();
  }

  drawTrail(context, mark, px) {
    if (mark.trail.length < 2) return;
    context.strokeStyle = colour(`--${mark.kind}`);
    context.lineWidth = 2;
    const n = mark.trail.length;
    for (let i = 1; i < n; i++) {
      context.globalAlpha = 0.08 + 0.42 * i / n;
      context.beginPath();
      context.moveTo(...px(...mark.trail[i - 1]));
      context.lineTo(...px(...mark.trail[i]));
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  drawPair(context, places, px) {
    const ends = this.pair && [places.get(this.pair.cyclist), places.get(this.pair.pedestrian)];
    if (!ends || !ends[0] || !ends[1]) return;
    const [a, b] = ends.map((end) => px(...end));
    const tone = this.alerting ? "alert" : "warning";
    context.strokeStyle = colour(`--${tone}`);
    context.lineWidth = this.alerting ? 4 : 2.5;
    context.setLineDash(this.alerting ? [] : [7, 5]);
    context.beginPath();
    context.moveTo(...a);
    context.lineTo(...b);
    context.stroke();
    context.setLineDash([]);
    const word = metres(this.pair.distance_m);
    context.font = `600 13px ${getComputedStyle(document.body).fontFamily}`;
    const wide = context.measureText(word).width + 12;
    if (Math.hypot(b[0] - a[0], b[1] - a[1]) < wide + 40) return;
    const [u, v] = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    context.fillStyle = colour(`--${tone}`);
    context.beginPath();
    context.roundRect(u - wide / 2, v - 11, wide, 22, 3);
    context.fill();
    context.fillStyle = colour(`--on-${tone}`);
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(word, u, v + 0.5);
  }

  // Where it will be in a second.
  drawArrow(context, mark, [x, y], px) {
    if (Math.hypot(mark.vx, mark.vy) < 0.3 || Math.hypot(x, y) > this.range) return;
    context.strokeStyle = colour(`--${mark.kind}`);
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(...px(x, y));
    context.lineTo(...px(x + mark.vx, y + mark.vy));
    context.stroke();
  }

  drawMark(context, mark, [x, y], px, width, height) {
    const far = Math.hypot(x, y) > this.range;
    const k = far ? this.range / Math.hypot(x, y) : 1;
    const [u, v] = px(x * k, y * k);
    if (v > height - 6) return;
    const ink = colour(`--${mark.kind}`);
    const fast = Math.hypot(mark.vx, mark.vy);
    const angle = fast > 0.3 ? Math.atan2(mark.vy, mark.vx) : 0;
    context.save();
    context.translate(u, v);
    context.rotate(angle);
    context.fillStyle = mark.unseen_s > 0 ? colour("--panel") : ink;
    context.strokeStyle = mark.unseen_s > 0 ? ink : colour("--panel");
    context.lineWidth = 2;
    context.globalAlpha = far ? 0.6 : 1;
    context.beginPath();
    if (mark.kind === "pedestrian") context.arc(0, 0, 7, 0, 2 * Math.PI);
    else if (mark.kind === "cyclist") {
      context.moveTo(0, -11);
      context.lineTo(8, 8);
      context.lineTo(0, 4);
      context.lineTo(-8, 8);
      context.closePath();
    } else context.rect(-7, -7, 14, 14);
    context.fill();
    context.stroke();
    context.restore();
    if (far) return;
    context.font = `600 12px ${getComputedStyle(document.body).fontFamily}`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.lineWidth = 3;
    context.strokeStyle = colour("--sunk");
    context.fillStyle = ink;
    const spot = [Math.min(u + 11, width - 20), v - 11];
    context.strokeText(String(mark.id), ...spot);
    context.fillText(String(mark.id), ...spot);
  }
}
