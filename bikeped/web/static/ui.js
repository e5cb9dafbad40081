// Shared by all pages: elements, requests, messages, formats, states, canvases, the theme.

const SVG = "http://www.w3.org/2000/svg";

export const $ = (selector, within = document) => within.querySelector(selector);

// An element: el("p", {class: "note", hidden: true}, "text", child). Text is always text.
export function el(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

export function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : String(value));
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

// Sets an element's text only when it differs, which keeps selections and screen readers undisturbed.
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// --- requests

class RequestError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

// request("/align/fit", {json: {...}}) posts to the server, without `json` it gets. Returns the answer's
// JSON (or text), or throws an error with `status` and a readable message. Without a session the login
// page opens.
export async function request(path, { json, method, signal } = {}) {
  const options = { method: method ?? (json === undefined ? "GET" : "POST"), signal, headers: { Accept: "application/json" } };
  if (json !== undefined) {
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(json);
  }
  let answer;
  try {
    answer = await fetch(path, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new RequestError("The server does not answer.", 0);
  }
  if (answer.status === 401) {
    location.reload();
    throw new RequestError("Log in again.", 401);
  }
  const isJson = (answer.headers.get("Content-Type") ?? "").startsWith("application/json");
  const body = isJson ? await answer.json() : await answer.text();
  if (!answer.ok) throw new RequestError((isJson && body.error) || String(body) || `status ${answer.status}`, answer.status);
  return body;
}

// --- messages

// Announces a line to screen readers.
export function announce(text) {
  const place = $("#announcer");
  place.textContent = "";
  requestAnimationFrame(() => { place.textContent = text; });
}

// A line at the foot of the page for some seconds; kind "bad" for errors.
export function toast(text, kind = "") {
  const node = el("p", { class: `toast ${kind}`, role: kind === "bad" ? "alert" : "status" }, text);
  const place = $("#toasts");
  while (place.children.length > 3) place.firstChild.remove();
  place.append(node);
  setTimeout(() => node.remove(), kind === "bad" ? 9000 : 4000);
}

// Downloads a text as a file.
export function download(text, name, type) {
  const link = el("a", { href: URL.createObjectURL(new Blob([text], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// --- formats: a figure with its unit, a dash where there is none

const known = (value) => typeof value === "number" && Number.isFinite(value);
export const fixed = (value, digits, unit = "") => known(value) ? `${value.toFixed(digits)}${unit}` : "–";
export const metres = (value, digits = 1) => fixed(value, digits, "\u00a0m");
export const seconds = (value, digits = 1) => fixed(value, digits, "\u00a0s");
export const millis = (value, digits = 0) => fixed(value, digits, "\u00a0ms");
export const speed = (value, digits = 1) => fixed(value, digits, "\u00a0m/s");
export const count = (number, what) => `${number}\u00a0${what}${number === 1 ? "" : "s"}`;
export const percent = (value, digits = 1) => known(value) ? `${(100 * value).toFixed(digits)}\u00a0%` : "–";
export const clock = (time) => new Date(time).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit", hour12: false });
export function duration(value) {
  if (!known(value)) return "–";
  const s = Math.floor(value), d = Math.floor(s / 86400), h = Math.floor(s / 3600) % 24, m = Math.floor(s / 60) % 60;
  if (d) return `${d}\u00a0d ${h}\u00a0h`;
  if (h) return `${h}\u00a0h ${m}\u00a0min`;
  return m ? `${m}\u00a0min ${s % 60}\u00a0s` : `${s}\u00a0s`;
}

// --- states: never by colour alone

export const STATES = { IDLE: "Idle", SAFE: "Safe", WARNING: "Warning", ALERT: "Alert", FAULT: "Fault", OFF: "Off", STALE: "No contact" };

// The state's shape: ring, disc, triangle, octagon, hatched square, bar, broken ring.
export function stateIcon(name) {
  const shapes = {
    IDLE: [svg("circle", { cx: 12, cy: 12, r: 9, class: "stroke" })],
    SAFE: [svg("circle", { cx: 12, cy: 12, r: 10, class: "fill" }), svg("path", { d: "m7.5 12.5 3 3 6-6.5", class: "cut" })],
    WARNING: [svg("path", { d: "M12 2 23 21.5H1Z", class: "fill" }), svg("path", { d: "M12 9v5.5m0 3v.1", class: "cut" })],
    ALERT: [svg("path", { d: "M7.4 1h9.2L23 7.4v9.2L16.6 23H7.4L1 16.6V7.4Z", class: "fill" }), svg("path", { d: "M12 6v7.5m0 4v.1", class: "cut" })],
    FAULT: [svg("rect", { x: 2, y: 2, width: 20, height: 20, class: "fill" }), svg("path", { d: "m7 7 10 10M17 7 7 17", class: "cut" })],
    OFF: [svg("circle", { cx: 12, cy: 12, r: 9, class: "stroke" }), svg("path", { d: "M5.6 18.4 18.4 5.6", class: "stroke" })],
    STALE: [svg("circle", { cx: 12, cy: 12, r: 9, class: "stroke", "stroke-dasharray": "4 4" })],
  };
  return svg("svg", { viewBox: "0 0 24 24", class: "state-icon", "aria-hidden": "true" }, shapes[name] ?? shapes.STALE);
}

// --- colours and canvases

// The value of a custom property, e.g. colour("--ink").
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

const themed = new Set(); // functions that redraw when the colours change

// Matches a canvas to the screen's resolution: calls `draw(context, width, height)`, in CSS pixels, at
// every change of size or theme. Returns the function that redraws.
export function canvasOf(canvas, draw) {
  let width = 0, height = 0;
  const paint = () => {
    if (width < 1 || height < 1) return;
    const context = canvas.getContext("2d");
    const scale = canvas.width / width;
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.clearRect(0, 0, width, height);
    draw(context, width, height);
  };
  new ResizeObserver(([entry]) => {
    ({ width, height } = entry.contentRect);
    const scale = Math.min(window.devicePixelRatio || 1, 3);
    canvas.width = Math.max(1, Math.round(width * scale));
    canvas.height = Math.max(1, Math.round(height * scale));
    paint();
  }).observe(canvas);
  themed.add(paint);
  return paint;
}

export const calm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

// --- the theme: as the device, light, dark

const THEMES = [["", "◐", "as the device"], ["light", "○", "light"], ["dark", "●", "dark"]];

function setUpTheme() {
  const button = $("#theme");
  const redrawAll = () => themed.forEach((redraw) => redraw());
  const show = () => {
    const [, mark, word] = THEMES.find(([name]) => name === (document.documentElement.dataset.theme ?? ""));
    setText($("#theme-mark"), mark);
    button.setAttribute("aria-label", `Colours: ${word}`);
    button.title = `Colours: ${word}`;
  };
  button.addEventListener("click", () => {
    const now = THEMES.findIndex(([name]) => name === (document.documentElement.dataset.theme ?? ""));
    const [name, , word] = THEMES[(now + 1) % THEMES.length];
    if (name) document.documentElement.dataset.theme = name;
    else delete document.documentElement.dataset.theme;
    try { localStorage.setItem("theme", name); } catch { /* storage is off */ }
    show();
    announce(`Colours: ${word}`);
    redrawAll();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
  show();
}

setUpTheme();
