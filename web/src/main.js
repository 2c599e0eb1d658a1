// The current frame is shared by the slider, the view, the images and the plots; each of them can select another.

import { digits3, fixed, kindColor, make, readData, readImages } from "./data.js";
import "./page.css";
import { makePlots } from "./plots.js";
import { makeStills } from "./stills.js";
import { makeViewer } from "./viewer.js";

const $ = (id) => document.getElementById(id);
// Playback rate, frames per second, if frames have no times.
const RATE = 8;

const data = readData();
const images = readImages(data);
// Runs of consecutive frames of one kind: first frame, last frame, kind.
data.stretches = [];
data.kinds.forEach((kind, k) => {
  const last = data.stretches.at(-1);
  if (last && last[2] === kind) last[1] = k;
  else data.stretches.push([k, k, kind]);
});

const slider = $("slider");
const play = $("play");
let current = 0;

// --- the 3D view, which requires WebGL ----------------------------------------------------------------------------------
let viewer = null;
try {
  viewer = makeViewer($("view"), data, images);
  $("scene-legend").textContent = viewer.legend.join(" \u00b7 ");
  const views = $("views");
  data.cameras.forEach((name, c) => views.append(make("option", { value: `camera ${c}` }, `from ${name}`)));
  views.addEventListener("change", () => viewer.fit(views.value));
  $("reset").addEventListener("click", () => viewer.fit(views.value));
} catch (error) {
  $("view").append(make("p", { class: "none" }, `This browser cannot draw in three dimensions (${error.message}).`));
}
const stills = images.n ? makeStills($("stills"), data, images) : null;
if (!images.n) $("images").hidden = !$("images").querySelector("a");
$("drawn").addEventListener("change", () => $("stills").classList.toggle("hide-drawn", !$("drawn").checked));
const plots = makePlots($("plots"), data, (k) => go(k));
document.querySelector(".over-time").hidden = !plots.panels().length;
$("zoom-in").addEventListener("click", () => plots.zoom(0.5));
$("zoom-out").addEventListener("click", () => plots.zoom(2));
$("zoom-all").addEventListener("click", () => plots.zoom(0));

// --- the band of statuses under the slider -----------------------------------------------------------------------------
function band() {
  const canvas = $("band");
  canvas.width = Math.max(1, canvas.clientWidth * devicePixelRatio);
  canvas.height = Math.max(1, canvas.clientHeight * devicePixelRatio);
  const pen = canvas.getContext("2d");
  for (const [from, to, kind] of data.stretches) {
    pen.fillStyle = kindColor(kind);
    const x = (from / data.n) * canvas.width;
    pen.fillRect(x, 0, Math.max(devicePixelRatio, ((to + 1 - from) / data.n) * canvas.width), canvas.height);
  }
}
new ResizeObserver(band).observe($("band"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", band);

const names = { tracked: "tracked", again: "relocalized", coasting: "coasting, interpolated", uncertain: "uncertain, contradicted, ambiguous", none: "no pose" };
for (const kind of Object.keys(names)) {
  if (!data.kinds.includes(kind)) continue;
  $("band-legend").append(make("span", { class: kind }, make("i", {}), names[kind]));
}

// --- facts of the current frame ----------------------------------------------------------------------------------------
const precision = Math.min(7, Math.max(0, 3 - Math.floor(Math.log10(Math.max(data.axisLength, 1e-9)))));
const time = (k) => (data.inSeconds ? `${fixed(data.times[k], 3)} s` : "");

function facts(k) {
  if (!data.hasPose[k]) return [];
  const axes = ["x", "y", "z"];
  const sd = (j, factor) => (Number.isFinite(data.sigma[6 * k + j]) ? digits3(data.sigma[6 * k + j] * factor) : "unbounded");
  const place = axes.map((axis, j) => [
    axis, fixed(data.place[3 * k + j] + data.center[j], precision), sd(3 + j, data.sd[0]), sd(j, 1),
  ]);
  const turns = data.angles.map((name, j) => [name, fixed(data.angle[3 * k + j], 2)]);
  return [
    table(["", `position, ${data.unit}`, `sd, ${data.sd[1]}`, "rotation sd, \u00b0"], place), table(["", "angle, \u00b0"], turns),
  ];
}

function table(head, rows) {
  const line = (cells, name) => make("tr", {}, ...cells.map((cell, j) => make(j ? name : "th", {}, cell)));
  return make("table", {}, make("thead", {}, line(head, "th")), make("tbody", {}, ...rows.map((row) => line(row, "td"))));
}

function showFacts(k) {
  const [status, text] = data.statuses[data.status[k]];
  const reason = data.reasons[data.reason[k]];
  const fault = data.faults[data.fault[k]];
  $("at").replaceChildren(make("b", {}, `Frame ${data.index[k]}`), ` ${time(k)}`);
  $("status").textContent = status;
  $("status").className = `status ${data.kinds[k]}`;
  $("now-facts").replaceChildren(...facts(k));
  const why = [reason && `${reason[0].toUpperCase()}${reason.slice(1)}${/[.!?]$/.test(reason) ? "" : "."}`, fault].filter(Boolean);
  $("why").replaceChildren(...[text, ...why].map((sentence, i) => make("p", i ? { class: "reason" } : {}, sentence)));
  const overlay = $("view-said");
  overlay.hidden = data.hasPose[k];
  overlay.textContent = data.hasPose[k] ? "" : `${status}: ${reason || text}`;
  slider.setAttribute("aria-valuetext", `frame ${data.index[k]}${data.inSeconds ? `, ${time(k)}` : ""}, ${status}`);
  const j = images.nearest[k];
  if (j >= 0) {
    const off = images.index[j] !== data.index[k];
    $("still-of").textContent = off ? `of frame ${images.index[j]}, the nearest in this page` : `of frame ${images.index[j]}`;
  }
}

function go(k) {
  current = Math.min(Math.max(Math.round(k), 0), data.n - 1);
  slider.value = current;
  const j = images.nearest[current];
  viewer?.show(current);
  if (stills) {
    stills.show(j);
    stills.count(current);
    viewer?.showStill(j, stills.sources(j));
  }
  plots.show(current);
  showFacts(current);
}

// --- time --------------------------------------------------------------------------------------------------------------
let started = null; // while playing: clock and recording times of the start
function tick(now) {
  if (!started) return;
  const speed = Number($("speed").value);
  const t = started.time + ((now - started.now) / 1000) * speed;
  let k = current;
  if (data.inSeconds) while (k + 1 < data.n && data.time[k + 1] <= t) k++;
  else k = Math.floor(t * RATE);
  if (k !== current) go(k);
  if (current >= data.n - 1) pause();
  else requestAnimationFrame(tick);
}

function begin() {
  if (current >= data.n - 1) go(0);
  started = { now: performance.now(), time: data.inSeconds ? data.time[current] : current / RATE };
  play.setAttribute("aria-label", "Pause");
  play.classList.add("playing");
  requestAnimationFrame(tick);
}

function pause() {
  started = null;
  play.setAttribute("aria-label", "Play");
  play.classList.remove("playing");
}

const toggle = () => (started ? pause() : begin());
play.addEventListener("click", toggle);
$("speed").addEventListener("change", () => started && begin());
slider.max = data.n - 1;
slider.addEventListener("input", () => {
  pause();
  go(Number(slider.value));
});

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.closest("input, select, textarea, summary, a")) return;
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (event.key === " " && !event.target.closest("button")) toggle();
  else if (step) {
    pause();
    go(current + step * (event.shiftKey ? 10 : 1));
  } else return;
  event.preventDefault();
});

go(0);
window.sylpose = {
  state: () => ({
    frame: current,
    index: data.index[current],
    frames: data.n,
    status: data.statuses[data.status[current]][0],
    matrix: viewer ? viewer.matrix() : null,
    visible: viewer ? viewer.visible() && data.hasPose[current] : false,
    hidden: viewer ? viewer.hidden() : null,
    playing: Boolean(started),
    range: plots.range(),
    panels: plots.panels(),
    still: images.n ? images.index[images.nearest[current]] : null,
  }),
};
