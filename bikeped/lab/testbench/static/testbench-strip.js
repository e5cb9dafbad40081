// A scenario as a strip: danger above, states below; the higher, the more urgent.

import { colour } from "/static/ui.js";
import { NAMES } from "/static/testbench-words.js";

// The strip in words.
export function stripWords(strip, entry) {
  const total = strip.frames;
  const share = (runs, code) => Math.round(100 * runs.filter(([c]) => c === code).reduce((sum, [, n]) => sum + n, 0) / total);
  return `${strip.name}: alert ${share(strip.after, 3)} % of the time${strip.before ? `, before ${share(strip.before, 3)} %` : ""}; danger ${share(strip.truth, 1) + share(strip.truth, 2)} %${entry ? "; changed" : ""}`;
}

export function drawStrip(context, width, height, strip, both) {
  const x = (f) => f / strip.frames * width;
  const lane = (runs, top, tall, heights, paint, alpha = 1) => {
    let at = 0;
    context.globalAlpha = alpha;
    for (const [code, count] of runs) {
      const part = heights[code];
      context.fillStyle = paint(code);
      if (part) context.fillRect(x(at), top + tall * (1 - part), Math.max(x(at + count) - x(at), 0.75), tall * part);
      at += count;
    }
    context.globalAlpha = 1;
  };
  const state = (code) => colour(`--${NAMES[code].toLowerCase()}`);
  const steps = [0.2, 0.4, 0.65, 1];
  lane(strip.truth, 0, 5, [0, 1, 1], (code) => colour(code === 1 ? "--actionable" : "--imminent"));
  context.fillStyle = colour("--line");
  context.fillRect(0, 5, width, 1);
  if (both && strip.before) {
    const tall = (height - 9) / 2;
    lane(strip.before, 7, tall, steps, state, 0.45);
    lane(strip.after, 9 + tall, tall, steps, state);
  } else lane(strip.after, 7, height - 7, steps, state);
}
