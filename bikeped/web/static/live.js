// The live page. Server-sent events: `hello` once, `now` up to ten times a second, `status` every
// second, `alerts` and `trend` when they change. Without events the page turns grey and says so.

import { $, STATES, announce, canvasOf, clock, colour, count, duration, el, fixed, metres, millis, seconds, setText, speed, stateIcon } from "/static/ui.js";
import { line } from "/static/canvas.js";
import { Radar } from "/static/radar.js";

const CONTACT_S = 2.5;       // contact is lost after this long without an event
const OLD_S = 2;             // a signal or picture older than this is out of date
const RETRY_S = 3;
const TREND_S = 120;         // the lines of the latencies go back so far
const ANNOUNCE_S = 3;        // shortest time between two announcements to screen readers
const STAGE_WORDS = {
  acquire: "Capture", pre: "Decode, scale", inference: "Detect", post: "Filter detections",
  track: "Track", decide: "Decide", feedback: "Set the light", total: "Total", capture_age: "Capture to light",
};

const radar = new Radar($("#radar"));
const trend = [];
let hello = null;
let source = null;
let lastEvent = null;        // time of the last event
let shownState = null;
let shownSince = null;       // since when, by this page's clock
let lostSince = performance.now();
let refusal = null;          // why the device refuses this page
let retry = null;
let paused = false;          // by the Pause button
let broken = false;          // the picture's stream has ended
let pictureStarted = 0;

// --- contact

function connect() {
  if (document.hidden || source !== null) return;
  source = new EventSource("/live/events");
  const on = (name, handle) => source.addEventListener(name, (event) => {
    lastEvent = performance.now();
    handle(JSON.parse(event.data));
  });
  on("hello", onHello);
  on("now", onNow);
  on("alerts", showAlerts);
  on("status", showStatus);
  on("trend", onTrend);
  source.onerror = () => {
    if (source === null || source.readyState !== EventSource.CLOSED) return;
    disconnect();
    findRefusal();
    retry = setTimeout(connect, RETRY_S * 1000);
  };
}

function disconnect() {
  clearTimeout(retry);
  source?.close();
  source = null;
}

// The browser gives no reason for a refused stream: ask for one.
async function findRefusal() {
  try {
    const answer = await fetch("/live/room", { headers: { Accept: "text/plain" } });
    if (answer.status === 401) location.reload();
    refusal = answer.status === 503 ? "The device allows no more live pages. Close one." : null;
  } catch {
    refusal = null;
  }
}

function onHello(data) {
  refusal = null;
  if (hello !== null && hello.config_hash !== data.config_hash) trend.length = 0;
  hello = data;
  radar.describe(data);
  buildLatency(data.stages);
  startPicture();
}

function onNow(data) {
  const old = data.signal_age_s === null || data.signal_age_s > OLD_S;
  if (old) {
    showNoContact(data.signal_age_s === null
      ? "The device has not set its light yet."
      : `The device answers, but has decided nothing for ${duration(data.signal_age_s)}.`);
    return;
  }
  $("#live").dataset.contact = "live";
  lostSince = null;
  radar.setLive(true);
  showState(data.signal, data.sentence || STATES[data.signal] || data.signal);
  $("#state-sentence").title = data.detail; // the test's numbers, one step away
  setText($("#light-now"), lightWords(data));
  $("#state-facts").hidden = false;
  showPair(data);
  showTracks(data);
  showPictureAge(data);
  radar.show(data.tracks, data.pair, data.decided === "ALERT" && data.signal !== "FAULT");
}

function lightWords({ colour, blink_hz }) {
  if (colour === "off") return "dark";
  return blink_hz > 0 ? `${colour}, blinking` : colour;
}

// Without contact the page shows no state colour: only that, and since when.
function showNoContact(sentence) {
  lostSince ??= performance.now();
  $("#live").dataset.contact = lastEvent === null ? "none" : "lost";
  $("#state-facts").hidden = true;
  radar.setLive(false);
  showState("STALE", sentence);
  if (!paused) setText($("#picture-note"), broken ? "The picture has stopped." : "This picture is out of date.");
}

setInterval(() => {
  const now = performance.now();
  if (shownSince !== null) setText($("#state-for"), duration((now - shownSince) / 1000));
  if (lastEvent !== null && now - lastEvent < CONTACT_S * 1000) return;
  const from = lastEvent ?? lostSince ?? now;
  if (lastEvent === null && refusal === null && now - from < CONTACT_S * 1000) return;
  const ago = duration((now - from) / 1000);
  showNoContact(refusal ?? (lastEvent === null
    ? "The device does not answer."
    : `No data from the device for ${ago}. What is shown below is out of date.`));
}, 500);

document.addEventListener("visibilitychange", () => {
  // A page in the background takes no data.
  if (document.hidden) {
    disconnect();
    stopPicture();
  } else {
    connect();
  }
});
addEventListener("pagehide", () => { disconnect(); stopPicture(); });
addEventListener("pageshow", (event) => { if (event.persisted) connect(); });

// --- the state

let announcedAt = -Infinity;
let pendingAnnouncement = null;

function announceLimited(text) {
  clearTimeout(pendingAnnouncement);
  const wait = announcedAt + ANNOUNCE_S * 1000 - performance.now();
  if (wait > 0) {
    pendingAnnouncement = setTimeout(() => announceLimited(text), wait);
    return;
  }
  announcedAt = performance.now();
  announce(text);
}

function showState(name, sentence) {
  const word = STATES[name] ?? name;
  if (name !== shownState) {
    shownState = name;
    shownSince = performance.now();
    $("#state").dataset.state = name;
    $("#state-mark").replaceChildren(stateIcon(name));
    setText($("#state-word"), word);
    document.title = `${word} · Live · bikeped`;
    announceLimited(`${word}. ${sentence}`);
  }
  setText($("#state-sentence"), withoutName(name, sentence));
}

// "ALERT: cyclist 3 ..." under the word ALERT would repeat it.
function withoutName(name, sentence) {
  const rest = sentence.startsWith(`${name}: `) ? sentence.slice(name.length + 2) : sentence;
  return rest.charAt(0).toUpperCase() + rest.slice(1);
}

// --- the picture

function startPicture() {
  if (paused || document.hidden) return;
  if (document.readyState !== "complete") {
    // A stream never ends: started earlier, it would keep the load event from firing.
    addEventListener("load", startPicture, { once: true });
    return;
  }
  broken = false;
  pictureStarted = performance.now();
  $("#picture").src = `/live/stream?from=${Date.now()}`;
  setText($("#picture-note"), "");
}

function stopPicture() {
  $("#picture").removeAttribute("src");
}

$("#picture").addEventListener("load", ({ target }) => {
  if (target.naturalWidth > 0) [target.width, target.height] = [target.naturalWidth, target.naturalHeight];
});
$("#picture").addEventListener("error", () => {
  broken = true;
  setText($("#picture-note"), "The picture has stopped.");
});

$("#picture-switch").addEventListener("click", () => {
  paused = !paused;
  const button = $("#picture-switch");
  button.setAttribute("aria-pressed", String(paused));
  setText(button, paused ? "Resume" : "Pause");
  if (paused) {
    stopPicture();
    setText($("#picture-note"), "Paused: no picture is sent.");
  } else {
    startPicture();
  }
});

function showPictureAge({ frame_age_s }) {
  const old = frame_age_s === null || frame_age_s > OLD_S;
  $("#picture-frame").toggleAttribute("data-old", old);
  if (paused) return;
  if (broken) {
    if (performance.now() - pictureStarted > RETRY_S * 1000) startPicture();
    return;
  }
  setText($("#picture-note"), frame_age_s === null ? "No picture yet." : old ? `This picture is ${duration(frame_age_s)} old.` : "");
}

// --- pair, tracks

function showPair({ pair }) {
  const none = pair === null;
  $("#why").hidden = none;
  $("#why-none").hidden = !none;
  if (none) return;
  facts($("#why"), [
    ["Pair", `cyclist ${pair.cyclist} and pedestrian ${pair.pedestrian}`],
    ["Distance", metres(pair.distance_m)],
    [`${seconds(pair.lookback_s, 2)} before`, metres(pair.distance_then_m, 2)],
    ["Rule's limits", `${metres(pair.d_min_m)} and ${metres(pair.d_max_m)}`],
    ["Cyclist", `${speed(pair.speed_mps)}, moved ${metres(pair.displacement_m, 2)}`],
  ]);
}

// Rows of a description list, changed in place.
function facts(list, rows) {
  while (list.children.length > 2 * rows.length) list.lastChild.remove();
  rows.forEach(([name, value, kind], i) => {
    if (!list.children[2 * i]) list.append(el("dt"), el("dd"));
    setText(list.children[2 * i], name);
    const place = list.children[2 * i + 1];
    setText(place, value);
    place.className = kind ?? "";
  });
}

function showTracks({ tracks, pair }) {
  const body = $("#tracks");
  $("#tracks-none").hidden = tracks.length > 0;
  $("#tracks-scroll").hidden = tracks.length === 0;
  const away = (track) => Math.hypot(track.x, track.y);
  const order = [...tracks].sort((a, b) => away(a) - away(b)).slice(0, 12);
  while (body.children.length > order.length) body.lastChild.remove();
  order.forEach((track, i) => {
    const row = body.children[i] ?? body.appendChild(el("tr", {},
      el("th", { scope: "row" }, el("span", { class: "swatch", "aria-hidden": "true" }), el("span")),
      el("td", { class: "number" }), el("td", { class: "number" }), el("td")));
    const [who, far, fast, seen] = row.children;
    who.firstChild.className = `swatch ${track.kind}`;
    setText(who.lastChild, `${track.kind} ${track.id}`);
    setText(far, metres(away(track)));
    setText(fast, speed(Math.hypot(track.vx, track.vy)));
    setText(seen, track.unseen_s > 0 ? `${seconds(track.unseen_s)} ago` : "now");
    row.toggleAttribute("data-paired", pair !== null && (track.id === pair.cyclist || track.id === pair.pedestrian));
  });
  $("#radar").setAttribute("aria-label", order.length === 0 ? "No road users" : `${order.length} road users; the table of road users has the figures`);
}

// --- alerts

function showAlerts(alerts) {
  const list = $("#alerts");
  list.hidden = alerts.length === 0;
  $("#alerts-none").hidden = alerts.length > 0;
  list.replaceChildren(...[...alerts].reverse().map((alert) => {
    const lasts = alert.ended_unix_s === null;
    const pair = alert.pair;
    return el("li", {},
      el("p", { class: "when" },
        el("span", {}, clock(alert.started_unix_s * 1000)),
        el("span", { class: lasts ? "going" : "" }, lasts ? "now" : seconds(alert.ended_unix_s - alert.started_unix_s))),
      el("p", {}, withoutName("ALERT", alert.sentence)),
      pair && el("p", { class: "figures" },
        `${metres(pair.distance_m)} at the start${lasts ? "" : `, ${metres(alert.nearest_m)} at the closest`}; cyclist ${speed(pair.speed_mps)}${lasts ? "" : `; ${count(alert.frames, "frame")}`}`));
  }));
}

// --- health

function showStatus({ health, mqtt }) {
  const faults = $("#faults");
  faults.hidden = health.faults.length === 0;
  faults.replaceChildren(...health.faults.map((text) => el("li", {}, text)));
  const part = ({ ok, detail }) => [detail, ok ? "ok-mark" : "bad-mark"];
  const lost = health.counters;
  const rows = [
    ["Camera", ...part(health.camera)],
    ["Picture", ...part(health.picture)],
    ["Camera moved", driftWords(health.drift)],
    ["Detector", ...part(health.detector)],
    ["Light", ...part(health.light)],
    ["MQTT", ...brokerWords(mqtt)],
    ["Frame rate", `${fixed(health.fps, 1)} frames/s`],
    ["Newest frame", health.camera.capture_age_ms === null ? "none yet" : `${millis(health.camera.capture_age_ms)} old`],
    ["Since start", `${duration(health.uptime_s)}, ${count(lost.frames, "frame")}, ${count(lost.alerts, "alert")}`],
    ["Lost", `${lost.dropped} replaced, ${lost.undecodable} undecodable, ${lost.failed} failed, ${lost.out_of_order} out of order, ${lost.mqtt_dropped} messages, ${lost.audit_dropped} audit lines, ${lost.log_dropped} log lines`],
    ["Camera source", hello?.source ?? "–"],
    ["Model", hello?.detector ?? "–"],
    ["Rule", hello ? `${hello.rule}, configuration ${hello.config_hash.slice(0, 12)}` : "–"],
    ["Version", health.version],
  ];
  facts($("#health"), rows);
  showChecks(health.checks);
  for (const [stage, row] of latencyRows) {
    const figures = health.latency_ms[stage];
    ["p50", "p95", "max"].forEach((name, i) => setText(row.children[2 + i], figures ? fixed(figures[name], figures[name] < 10 ? 2 : 0) : "–"));
  }
}

function driftWords(drift) {
  if (drift === null || drift.metres_at_10m === null) return "not measured yet";
  return `${fixed(drift.metres_at_10m, 2)} m at 10 m, ${fixed(drift.degrees, 1)}°, ${fixed(drift.pixels, 1)} px since ${drift.since_start ? "the start" : "it was aligned"}`;
}

function showChecks(checks) {
  $("#checks").hidden = checks.length === 0;
  const number = (value) => el("td", { class: "number" }, value === null ? "–" : fixed(value, 2));
  $("#checks-rows").replaceChildren(...checks.map((check) => el("tr", {},
    el("th", { scope: "row", class: check.active ? "bad-mark" : "ok-mark" }, check.code.replace("picture.", "").replace("_", " ")),
    number(check.value), number(check.threshold), el("td", { class: "number" }, seconds(check.hold_s)))));
}

function brokerWords(mqtt) {
  if (mqtt === null) return ["not configured", ""];
  if (mqtt.connected) return [`connected to ${hello?.broker ?? "the broker"}, ${mqtt.published} messages sent`, "ok-mark"];
  return [`not connected to ${hello?.broker ?? "the broker"}${mqtt.error ? `: ${mqtt.error}` : ""}`, "bad-mark"];
}

// --- latencies

const latencyRows = new Map();
const trendPaints = [];

function buildLatency(stages) {
  if (latencyRows.size) return;
  stages.forEach((stage, i) => {
    const canvas = el("canvas", { "aria-hidden": "true" });
    const row = el("tr", { "data-stage": stage },
      el("th", { scope: "row" }, STAGE_WORDS[stage] ?? stage), el("td", {}, canvas),
      el("td", { class: "number" }, "–"), el("td", { class: "number" }, "–"), el("td", { class: "number" }, "–"));
    $("#latency").append(row);
    latencyRows.set(stage, row);
    trendPaints.push(canvasOf(canvas, (context, width, height) => drawTrend(context, width, height, i)));
  });
}

// Two lines of a stage: the median, and what 95 of 100 frames stay below.
function drawTrend(context, width, height, stage) {
  const points = trend.map(({ unix_s, p50, p95 }) => ({ at: unix_s, p50: p50[stage], p95: p95[stage] })).filter(({ p50 }) => p50 !== null);
  line(context, [[0, height - 0.5], [width, height - 0.5]], { stroke: colour("--line") });
  if (points.length < 2) return;
  const end = points[points.length - 1].at;
  const top = Math.max(...points.map(({ p95 }) => p95), 1e-3) * 1.12;
  const curve = (key, style) => line(context, points.flatMap((point, i) => {
    const at = [width - (end - point.at) / TREND_S * width, height - 2 - point[key] / top * (height - 4)];
    // A pause is a gap, not a slope.
    return i && point.at - points[i - 1].at > 3 ? [null, at] : [at];
  }), style);
  curve("p95", { stroke: colour("--line-strong"), width: 1.5, dash: [2, 2] });
  curve("p50", { stroke: colour("--accent"), width: 1.8 });
}

function onTrend(points) {
  const last = trend.length ? trend[trend.length - 1].unix_s : -Infinity;
  trend.push(...points.filter((point) => point.unix_s > last));
  while (trend.length > 120) trend.shift();
  trendPaints.forEach((paint) => paint());
}

connect();
