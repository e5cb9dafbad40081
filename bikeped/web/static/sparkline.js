// Two lines over the last two minutes: median and 95th percentile.

import { line } from "/static/canvas.js";
import { canvasOf, colour } from "/static/ui.js";

const SPAN_S = 120;

export class Sparkline {
  constructor(canvas) {
    this.points = [];
    this.paint = canvasOf(canvas, (context, width, height) => this.draw(context, width, height));
  }

  // [[unix seconds, p50, p95], ...], oldest first
  show(points) {
    this.points = points;
    this.paint();
  }

  draw(context, width, height) {
    const points = this.points.filter(([, p50]) => p50 !== null);
    line(context, [[0, height - 0.5], [width, height - 0.5]], { stroke: colour("--line") });
    if (points.length < 2) return;
    const end = points[points.length - 1][0];
    const top = Math.max(...points.map(([, , p95]) => p95), 1e-3) * 1.12;
    const curve = (column, style) => line(context, points.flatMap((point, i) => {
      const at = [width - (end - point[0]) / SPAN_S * width, height - 2 - point[column] / top * (height - 4)];
      // A pause is a gap, not a slope.
      return i && point[0] - points[i - 1][0] > 3 ? [null, at] : [at];
    }), style);
    curve(2, { stroke: colour("--line-strong"), width: 1.5, dash: [2, 2] });
    curve(1, { stroke: colour("--accent"), width: 1.8 });
  }
}
