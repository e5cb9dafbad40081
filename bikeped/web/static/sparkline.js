// Two lines over the last minutes: the median, and what 95 of 100 frames stay below.

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
    context.strokeStyle = colour("--line");
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(0, height - 0.5);
    context.lineTo(width, height - 0.5);
    context.stroke();
    if (points.length < 2) return;
    const end = points[points.length - 1][0];
    const top = Math.max(...points.map(([, , p95]) => p95), 1e-3) * 1.12;
    const line = (column, dash, tone, thick) => {
      context.strokeStyle = colour(tone);
      context.lineWidth = thick;
      context.setLineDash(dash);
      context.beginPath();
      let before = null;
      for (const point of points) {
        const u = width - (end - point[0]) / SPAN_S * width;
        const v = height - 2 - point[column] / top * (height - 4);
        // A pause is a gap, not a slope.
        if (before === null || point[0] - before > 3) context.moveTo(u, v);
        else context.lineTo(u, v);
        before = point[0];
      }
      context.stroke();
      context.setLineDash([]);
    };
    line(2, [2, 2], "--line-strong", 1.5);
    line(1, [], "--accent", 1.8);
  }
}
