// The test bench: requests runs of the deployed rule and shows them. It evaluates no rule itself.

import { $, announce, download, el, request, setText, toast } from "/static/ui.js";
import { controls, set } from "/static/testbench-controls.js";
import { editor } from "/static/testbench-editor.js";
import { flow } from "/static/testbench-flow.js";
import { plan } from "/static/testbench-plan.js";
import { player } from "/static/testbench-player.js";
import { suitePanel } from "/static/testbench-suite.js";
import { configurationName } from "/static/testbench-words.js";

const CLIENT = crypto.randomUUID?.().slice(0, 36) ?? String(Math.random());
const app = { about: null, bench: null, play: null, suite: null, own: new Map(), editing: false };
const REST_MS = 80;
let show, showControls, diagram, edits, suite, resting = 0, due = null;

// --- requests: one of a kind at a time; of those that wait only the newest is sent

function requestNewest(kind, take, status) {
  let busy = false, next = null;
  const state = (word) => { $("#tb").dataset[kind] = word; if (status) setText(status, word === "busy" ? "computing …" : ""); };
  const send = async (job) => {
    busy = true;
    state("busy");
    try {
      take(await request(`/testbench/${kind}`, { json: { bench: job.bench, client: CLIENT } }), job);
      if (kind !== "suite" || (!next && job.bench === app.wanted)) state("idle");
    } catch (error) {
      state("failed");
      if (error.status === 503) {
        next ??= job;
        await new Promise((wait) => setTimeout(wait, 1000));
      } else if (error.status !== 409) {
        failed(error);
        if (kind === "scenario") { due = null; $("#tb").dataset.suite = "failed"; }
      }
    }
    busy = false;
    if (next) { const job = next; next = null; send(job); }
  };
  return (bench, began = performance.now()) => {
    const job = { bench, began };
    if (busy) next = job;
    else send(job);
  };
}

function failed(error) {
  if (error.status === 400 && app.editing) edits.fail(error.message);
  else toast(error.message, "bad");
}

const askScenario = requestNewest("scenario", (data, job) => {
  app.play = data;
  edits.fail("");
  if (job.bench === app.bench) edits.show(data.script);
  show.load(data);
  rememberLink(data.link);
  document.documentElement.dataset.ready = "testbench";
  measured("bench:scenario", job);
  if (job.bench === app.bench) drawn();
}, $("#busy"));

const askSuite = requestNewest("suite", (data, job) => {
  app.suite = data;
  suite(data, null);
  setText($("#suite-title"), data.changes.length ? "The whole suite, before and after your changes" : "The whole suite");
  measured("bench:suite", job);
  const failing = data.after.gates.filter((gate) => !gate.holds).length;
  if (data.changes.length) announce(`Suite computed. ${failing ? `${failing} gates fail` : "All gates hold"}. ${data.changed.length} scenarios change.`);
  if (job.bench.perception.recall !== "all") askTrials(job.bench);
}, $("#suite-busy"));

const askTrials = requestNewest("trials", (data, job) => {
  if (app.suite && job.bench === app.wanted) suite(app.suite, data.trials);
});

// From the change to the frame that shows it; scripts/bench reads these.
function measured(name, job) {
  requestAnimationFrame(() => performance.measure(name, { start: job.began, end: performance.now() }));
}

let later = 0, latest = "";
function rememberLink(link) {
  latest = link;
  clearTimeout(later);
  later = setTimeout(() => history.replaceState(null, "", link ? `#${link}` : location.pathname), 400);
}

// --- changing

function change(bench, { scenarioOnly = false } = {}) {
  app.bench = bench;
  showControls(bench, app.about.base);
  showPicks();
  askScenario(bench);
  if (scenarioOnly) return;
  // The suite follows when the scenario is drawn and no further change came.
  app.wanted = bench;
  due = { bench, began: performance.now() };
  clearTimeout(resting);
  $("#tb").dataset.suite = "waiting";
}

function drawn() {
  if (!due) return;
  clearTimeout(resting);
  resting = setTimeout(() => { const { bench, began } = due; due = null; askSuite(bench, began); }, REST_MS);
}

function choose(name) {
  show.rewind();
  edits.rebuild();
  change({ ...app.bench, scenario: name }, { scenarioOnly: true });
}

function withOwn(bench) {
  return { ...bench, scripts: [...app.own.values()].map((script) => JSON.stringify(script)) };
}

// Takes an edited script; a changed bundled scenario gets a new name.
function redraw(script) {
  const bundled = app.about.scenarios.some((s) => s.name === script.name);
  if (bundled && !app.own.has(script.name)) script.name = freeName(script.name);
  for (const name of app.own.keys()) if (name === app.bench.scenario && name !== script.name) app.own.delete(name);
  app.own.set(script.name, script);
  change(withOwn({ ...app.bench, scenario: script.name }));
  return script.name;
}

function freeName(name) {
  let free = `${name}, changed`;
  for (let i = 2; app.own.has(free); i++) free = `${name}, changed ${i}`;
  return free;
}

// --- the pickers above

function showPicks() {
  const { about, bench } = app;
  fillSelect($("#scenario"), [
    ...[...app.own.keys()].map((name) => [name, `✎ ${name}`, "Your own"]),
    ...about.scenarios.filter((s) => !app.own.has(s.name)).map((s) => [s.name, s.name, s.hazard]),
  ], bench.scenario);
  const same = Object.entries(about.configurations).find(([, decision]) => equal(decision, bench.decision));
  const names = Object.keys(about.configurations).map((name) => [name, configurationName(name) + (name === about.in_force ? ", in force" : "")]);
  fillSelect($("#configuration"), [...(same ? [] : [["", "Your own"]]), ...names], same ? same[0] : "");
  const others = [["", "nothing"], ...names];
  fillSelect($("#beside-1"), others, bench.beside[0] ?? "");
  fillSelect($("#beside-2"), others, bench.beside[1] ?? "");
  $("#beside-2-label").hidden = !bench.beside.length;
  $("#reset").disabled = equal({ ...bench, scenario: "", beside: [] }, { ...about.base, scenario: "", beside: [] });
}

function fillSelect(select, options, value) {
  const key = JSON.stringify(options);
  if (select.dataset.of !== key) {
    select.dataset.of = key;
    const groups = new Map();
    for (const [id, text, group] of options) {
      const place = group === undefined ? select : groups.get(group) ?? groups.set(group, el("optgroup", { label: group })).get(group);
      if (place === select) { if (!groups.has(id)) groups.set(` ${id}`, el("option", { value: id }, text)); } else place.append(el("option", { value: id }, text));
    }
    select.replaceChildren(...groups.values());
  }
  select.value = value;
}

const equal = (a, b) => JSON.stringify(a) === JSON.stringify(b);

// --- files and links

const plainName = (text) => text.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "") || "scenario";

async function saveScenario() {
  try {
    const { text, script } = await request("/testbench/read-scenario", { json: { text: JSON.stringify(app.play.script), name: "scenario" } });
    download(text, `${plainName(script.name)}.yaml`, "text/yaml");
  } catch (error) { toast(error.message, "bad"); }
}

async function loadScenario(file) {
  try {
    const { script } = await request("/testbench/read-scenario", { json: { text: await file.text(), name: file.name.slice(0, 100) } });
    app.own.set(script.name, script);
    show.rewind();
    edits.rebuild();
    change(withOwn({ ...app.bench, scenario: script.name }));
    announce(`${script.name} is open.`);
  } catch (error) { toast(error.message, "bad"); edits.fail(error.message); }
}

async function take(text, name) {
  const { bench } = await request("/testbench/read-challenge", { json: { text, name } });
  app.own.clear();
  for (const script of bench.scripts) {
    const answer = await request("/testbench/read-scenario", { json: { text: script, name: "scenario" } });
    app.own.set(answer.script.name, answer.script);
  }
  return bench;
}

async function loadChallenge(event) {
  const [file] = event.target.files;
  event.target.value = "";
  if (!file) return;
  try {
    const bench = await take(await file.text(), file.name.slice(0, 100));
    change(bench.scenario ? bench : { ...bench, scenario: app.bench.scenario });
    announce("File opened.");
  } catch (error) { toast(error.message, "bad"); }
}

async function copyLink() {
  const address = `${location.origin}${location.pathname}${latest ? `#${latest}` : ""}`;
  history.replaceState(null, "", address);
  try { await navigator.clipboard.writeText(address); toast("The link is copied."); } catch { toast("The link is in the address bar."); }
}

// --- start

function setEditing(on) {
  app.editing = on;
  $("#edit").setAttribute("aria-pressed", String(on));
  $("#editor").hidden = !on;
  show.paint();
  if (on) announce("Drawing: waypoints are squares in the plan, and a table below.");
}

async function start() {
  app.about = await request("/testbench/about");
  const first = { ...app.about.base, scenario: app.about.scenarios.find((s) => s.name === "Bike Approaches Ped")?.name ?? app.about.scenarios[0].name };
  diagram = flow($("#flow"));
  edits = editor($("#editor-body"), redraw, {
    save: saveScenario, load: loadScenario, touched: () => show.paint(),
    original: () => { app.own.delete(app.bench.scenario); edits.rebuild(); change(withOwn({ ...app.bench, scenario: app.about.scenarios[0].name })); },
  });
  show = player({ diagram, handles: () => (app.editing ? edits.handles() : null), editing: () => app.editing, plan: (canvas, where) => plan(canvas, where, edits.drag) });
  showControls = controls($("#controls"), app.about, (key, value) => change(set(app.bench, key, value), {}));
  suite = suitePanel($("#suite"), { open: (name) => { choose(name); scrollTo({ top: 0 }); }, save: () => download(app.suite.file, "challenge.json", "application/json"), link: copyLink, load: loadChallenge });
  $("#scenario").addEventListener("change", (event) => choose(event.target.value));
  $("#configuration").addEventListener("change", (event) => { const decision = app.about.configurations[event.target.value]; if (decision) change({ ...app.bench, decision }); });
  for (const id of ["beside-1", "beside-2"]) {
    $(`#${id}`).addEventListener("change", () => {
      const beside = [$("#beside-1").value, $("#beside-2").value].filter((name, i, all) => name && all.indexOf(name) === i);
      change({ ...app.bench, beside }, { scenarioOnly: true });
    });
  }
  $("#reset").addEventListener("click", () => { app.own.clear(); const kept = app.about.scenarios.some((s) => s.name === app.bench.scenario); change({ ...app.about.base, scenario: kept ? app.bench.scenario : first.scenario, beside: app.bench.beside }); });
  $("#copy-link").addEventListener("click", copyLink);
  $("#edit").addEventListener("click", () => setEditing(!app.editing));
  const { about } = app;
  $("#provenance").replaceChildren(
    "This page runs the deployed code. Code of the rule ", el("code", { title: about.rule_hash }, about.rule_hash.slice(0, 16)),
    ", suite ", el("code", { title: about.suite_hash }, about.suite_hash.slice(0, 16)), ", configuration ", el("code", { title: about.config_hash }, about.config_hash.slice(0, 16)), `, bikeped ${about.version}.`);
  let bench = first;
  if (location.hash.length > 1) {
    try {
      const linked = await take(location.hash.slice(1), "link");
      bench = linked.scenario ? linked : { ...linked, scenario: first.scenario };
    } catch (error) { toast(error.message, "bad"); }
  }
  change(bench);
}

start().catch((error) => { setText($("#headline"), `The test bench did not start: ${error.message}`); });
