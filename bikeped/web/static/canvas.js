// Drawing on a canvas, one call for each shape and text. Points are [x, y] in CSS pixels; a style is
// {fill, stroke, width, dash, alpha}.

// Fills and strokes what `trace()` adds to the path.
export function shape(context, trace, { fill, stroke, width = 1, dash = [], alpha = 1 }) {
  context.save();
  context.globalAlpha = alpha;
  context.beginPath();
  trace();
  if (fill) {
    context.fillStyle = fill;
    context.fill();
  }
  if (stroke) {
    context.strokeStyle = stroke;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.stroke();
  }
  context.restore();
}

// A line through points; a null among them is a gap.
export function line(context, points, style) {
  shape(context, () => traceLine(context, points), style);
}

export function polygon(context, points, style) {
  shape(context, () => {
    traceLine(context, points);
    context.closePath();
  }, style);
}

export function traceLine(context, points) {
  points.forEach((point, i) => {
    if (point) context[i && points[i - 1] ? "lineTo" : "moveTo"](...point);
  });
}

export function circle(context, [x, y], radius, style) {
  shape(context, () => context.arc(x, y, radius, 0, 2 * Math.PI), style);
}

// A text at the current font; `halo` is the colour around its letters.
export function text(context, words, [x, y], { fill, halo = null, align = "left", bold = false }) {
  context.save();
  if (bold) context.font = `600 ${context.font}`;
  context.textAlign = align;
  if (halo) {
    context.strokeStyle = halo;
    context.lineWidth = 4;
    context.lineJoin = "round";
    context.strokeText(words, x, y);
  }
  context.fillStyle = fill;
  context.fillText(words, x, y);
  context.restore();
}

// A text in a rounded box around (x, y).
export function chip(context, words, [x, y], { fill, ink, height = 20, radius = 10, bold = false }) {
  context.save();
  if (bold) context.font = `600 ${context.font}`;
  const half = context.measureText(words).width / 2 + 6;
  shape(context, () => context.roundRect(x - half, y - height / 2, 2 * half, height, radius), { fill });
  text(context, words, [x, y + 0.5], { fill: ink, align: "center" });
  context.restore();
}
