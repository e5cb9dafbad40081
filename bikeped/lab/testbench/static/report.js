// The report's playback: the test bench's views, from the data in the page.

import { $, canvasOf, el, percent, seconds } from "/static/ui.js";
import { flow } from "/static/testbench-flow.js";
import { plan } from "/static/testbench-plan.js";
import { player } from "/static/testbench-player.js";
import { drawStrip, stripWords } from "/static/testbench-timeline.js";

const data = JSON.parse($("#data").textContent);
const unrolled = (runs) => runs.flatMap(([code, count]) => Array(count).fill(code));
let index = 0;

for (const play of data.plays) {
  play.cameras = data.cameras;
  for (const side of play.sides.slice(1)) side.state = unrolled(side.state);
  for (const agent of play.agents) agent.missed = unrolled(agent.missed);
}

const show = player({
  diagram: flow($("#flow")),
  handles: () => null,
  editing: () => false,
  plan: (canvas, where) => plan(canvas, where),
});
const select = $("#scenario"), others = $("#others");

function load(next) {
  if (next !== index) show.rewind();
  index = next;
  select.selectedIndex = index;
  const play = data.plays[index];
  show.load(others.checked ? play : { ...play, sides: play.sides.slice(0, 1) });
}

select.replaceChildren(...data.plays.map((play) => el("option", {}, play.scenario.name)));
select.addEventListener("change", () => load(select.selectedIndex));
others.addEventListener("change", () => load(index));
$("#strips").replaceChildren(
  el("p", { class: "note" }, "Danger above (pale: a warning still helps, dark: too late), states below: the higher, the more urgent. Choose one to watch it."),
  el("ul", { class: "rp-grid" }, data.strips.map((strip, i) => {
    const canvas = el("canvas", { role: "img", "aria-label": stripWords(strip) });
    canvasOf(canvas, (context, width, height) => drawStrip(context, width, height, strip, false));
    const { metrics } = data.plays[i].sides[0];
    const summary = metrics.sensitivity === null ? "no danger in which a warning helps" : `${percent(metrics.sensitivity, 0)} of the danger warned of, shortest budget ${seconds(metrics.min_warning_budget_s, 2)}`;
    return el("li", {}, el("button", { type: "button", class: "su-open", onclick: () => { load(i); $("#watch").scrollIntoView(); } }, strip.name), canvas, el("p", { class: "note" }, summary));
  })));
load(Math.max(0, data.plays.findIndex((play) => play.scenario.name === "Bike Approaches Ped")));
