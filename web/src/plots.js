// Plots over time, in panels that zoom together.

import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { css, digits3, fixed, kindColor, make, readable } from "./data.js";

const AXES = ["x", "y", "z"];
const HEIGHT = 168;
// Angles that change by more have wrapped around, degrees (as in report.png).
const JUMP = 150;

export function makePlots(box, data, onPick) {
  const n = data.n;
  const column = (array, width, j, factor = 1) => Array.from({ length: n }, (_, k) => number(array[width * k + j] * factor));
  const measured = Array.from(data.kinds, (kind) => kind === "tracked" || kind === "again");
  const both = data.moved[0];
  const panels = [];
  let zooming = true; // until all panels exist
  let current = 0;

  const ofAxes = (array, width, first, factor, begin = [0, 0, 0]) => AXES.map((name, j) => ({
    name, color: () => css(`--${name}`), values: column(array, width, first + j).map((v) => v === null ? null : (v - begin[j]) * factor),
  }));
  if (data.anyPose) {
    const moved = ofAxes(data.place, 3, 0, both, data.begin);
    moved.forEach((s, j) => (s.sigma = column(data.sigma, 6, 3 + j, 2 * both)));
    add("Position since the start", data.moved[1], moved);
    const turns = data.angles.map((name, j) => ({
      name, color: () => css(`--${AXES[data.angleAxes[j]]}`), values: column(data.angle, 3, j), round: true,
    }));
    const total = { name: "total rotation", color: () => css("--ink"), values: column(data.turn, 1, 0), dash: [5, 4], thin: true };
    add("Angles", "degrees", [...turns, total]);
    add("Standard deviation of the rotation, about", "degrees", ofAxes(data.sigma, 6, 0, 1), { zero: true });
    add("Standard deviation of the position, along", data.sd[1], ofAxes(data.sigma, 6, 3, data.sd[0]), { zero: true });
  }
  const c = data.cameras.length;
  const ofCameras = (array) => data.cameras.map((name, j) => ({
    name, color: () => readable(data.colors[j]), values: column(array, c, j), dash: j < data.colors.length && j >= 9 ? [6, 3] : [],
  }));
  const matched = data.anyPose ? data.inliers : data.matches;
  if (matched.some((v) => v > 0)) {
    add(data.anyPose ? "Inliers" : "Features that match", "", ofCameras(matched), { zero: true, cameras: true });
  }
  if (data.anyPose) add("Residual, rms", "px", ofCameras(data.residuals), { zero: true, cameras: true });

  function add(title, unit, lines, { zero = false, cameras = false } = {}) {
    if (!lines.some((line) => line.values.some((v) => v !== null))) return;
    const series = [{}];
    const columns = [data.times];
    const bands = [];
    for (const line of lines) {
      const pale = line.values.map((v, k) => (measured[k] || cameras ? null : v));
      const sure = line.values.map((v, k) => (measured[k] || cameras ? v : null));
      const at = series.length;
      line.at = [at];
      series.push({
        label: line.name, stroke: line.color, width: line.thin ? 1.2 : 1.8, dash: line.dash, spanGaps: false,
        points: { show: n <= 90, size: 4 }, ...(line.round && { gaps: rounds(line.values) }),
      });
      columns.push(sure);
      if (pale.some((v) => v !== null)) {
        line.at.push(series.length);
        series.push({ stroke: line.color, paths: () => null, alpha: 0.55, points: { show: true, size: 3 } });
        columns.push(pale);
      }
      if (line.sigma) {
        const top = series.length;
        line.at.push(top, top + 1);
        bands.push({ series: [top, top + 1], fill: () => `${hex(line.color())}2e` });
        for (const sign of [1, -1]) {
          series.push({ stroke: line.color, width: 0, points: { show: false } });
          columns.push(line.values.map((v, k) => (v === null || line.sigma[k] === null ? null : v + sign * line.sigma[k])));
        }
      }
    }
    const head = make("div", { class: "panel-head" }, make("h3", {}, title, unit ? make("small", {}, ` ${unit}`) : ""));
    const legend = make("div", { class: "legend", role: "group", "aria-label": `Lines of: ${title}` });
    head.append(legend);
    const place = make("div", { class: "plot", role: "img", "aria-label": `${title}${unit ? `, ${unit}` : ""}, over time` });
    box.append(make("section", { class: "panel" }, head, place));
    const size = lines.flatMap((line) => line.values).reduce((most, v) => Math.max(most, Math.abs(v ?? 0)), 0);
    const panel = { title, lines, place, size, marker: make("div", { class: "marker" }), zero };
    panel.u = new uPlot(options(panel, series, bands, zero), columns, place);
    panel.u.over.append(panel.marker);
    for (const line of lines) {
      const value = make("output", {}, "");
      const swatch = make("i", {});
      const button = make("button", { type: "button", "aria-pressed": "true", title: `Show or hide ${line.name}` }, swatch, line.name, value);
      button.addEventListener("click", () => {
        const shown = button.getAttribute("aria-pressed") !== "true";
        button.setAttribute("aria-pressed", String(shown));
        for (const at of line.at) panel.u.setSeries(at, { show: shown });
      });
      legend.append(button);
      Object.assign(line, { value, swatch });
    }
    picked(panel.u);
    panels.push(panel);
  }

  function options(panel, series, bands, zero) {
    const grid = { stroke: () => css("--line"), width: 1 };
    const axis = { stroke: () => css("--muted"), grid, ticks: { ...grid, size: 4 }, font: "11px system-ui, sans-serif", gap: 4 };
    return {
      width: Math.max(200, panel.place.clientWidth), height: HEIGHT, series, bands, legend: { show: false },
      cursor: { sync: { key: "time", setSeries: false }, drag: { x: true, y: false, dist: 6 }, points: { size: 6 }, y: false },
      scales: {
        x: { time: false, range: (u, low, high) => wide(low, high) },
        y: { range: (u, low, high) => span(low, high, zero) },
      },
      axes: [
        { ...axis, size: 26, values: (u, ticks) => ticks.map((t) => String(t).replace("-", "\u2212")) },
        { ...axis, size: 58, values: (u, ticks) => ticks.map((t) => String(+t.toPrecision(6)).replace("-", "\u2212")) },
      ],
      hooks: {
        drawClear: [shade],
        setCursor: [(u) => u.cursor.event && values(u.cursor.left >= 0 ? u.cursor.idx : null)],
        setScale: [(u, key) => key === "x" && together(u)],
        setSize: [() => mark()],
      },
    };
  }

  // Shade frames without a measured pose in the color of their status.
  function shade(u) {
    const { left, top, width, height } = u.bbox;
    u.ctx.save();
    u.ctx.globalAlpha = 0.16;
    for (const [from, to, kind] of data.stretches) {
      if (kind === "tracked" || kind === "again") continue;
      const a = Math.max(left, u.valToPos(edge(from, -1), "x", true));
      const b = Math.min(left + width, u.valToPos(edge(to, 1), "x", true));
      if (b <= a) continue;
      u.ctx.fillStyle = kindColor(kind);
      u.ctx.fillRect(a, top, Math.max(1, b - a), height);
    }
    u.ctx.restore();
  }

  function edge(k, side) {
    const other = data.times[k + side];
    const step = n > 1 ? (data.times[n - 1] - data.times[0]) / (n - 1) : 1;
    return other === undefined ? data.times[k] + 0.5 * side * step : (data.times[k] + other) / 2;
  }

  function rounds(angles) {
    const jumps = angles.map((v, k) => k > 0 && v !== null && angles[k - 1] !== null && Math.abs(v - angles[k - 1]) > JUMP);
    return (u, s, first, last, gaps) => {
      const own = [];
      for (let k = Math.max(1, first); k <= last; k++) {
        // At least two pixels wide, as frames may be closer than that.
        if (jumps[k]) own.push([-1, 0].map((d) => Math.round(u.valToPos(data.times[k + d], "x", true)) + 2 * d + 1));
      }
      return [...gaps, ...own].sort((a, b) => a[0] - b[0]);
    };
  }

  function wide(low, high) {
    if (n < 2) return [data.times[0] - 0.5, data.times[0] + 0.5];
    return low !== null && high > low ? [low, high] : [data.times[0], data.times[n - 1]];
  }

  let range = [data.times[0], data.times[n - 1]];
  function together(u) {
    if (zooming) return;
    zooming = true;
    range = [u.scales.x.min, u.scales.x.max];
    for (const panel of panels) if (panel.u !== u) panel.u.setScale("x", { min: range[0], max: range[1] });
    zooming = false;
    mark();
  }

  function zoom(factor) {
    const first = data.times[0];
    const last = data.times[n - 1];
    if (factor === 0) return set(first, last);
    const at = Math.min(Math.max(data.times[current], range[0]), range[1]);
    const low = Math.max(first, at - (at - range[0]) * factor);
    const high = Math.min(last, at + (range[1] - at) * factor);
    // The range has at least two frames.
    if (high - low >= (2 * (last - first)) / Math.max(2, n - 1)) set(low, high);
    return undefined;
  }

  const set = (min, max) => panels[0]?.u.setScale("x", { min, max });

  function picked(u) {
    let x = null;
    u.over.addEventListener("pointerdown", (e) => (x = e.clientX));
    u.over.addEventListener("click", (e) => {
      if (x === null || Math.abs(e.clientX - x) > 5) return;
      onPick(u.posToIdx(e.clientX - u.over.getBoundingClientRect().left));
    });
  }

  function mark() {
    for (const { u, marker } of panels) {
      const x = u.valToPos(data.times[current], "x");
      marker.hidden = !(x >= -1 && x <= u.over.clientWidth + 1);
      marker.style.transform = `translateX(${x}px)`;
    }
  }

  function values(k) {
    const at = k ?? current;
    for (const { lines, size } of panels) {
      for (const line of lines) line.value.textContent = formatValue(line.values[at], size);
    }
  }

  function show(k) {
    current = k;
    mark();
    values(null);
  }

  function recolor() {
    for (const { u, lines } of panels) {
      for (const line of lines) line.swatch.style.background = line.color();
      u.redraw(true, true);
    }
  }

  new ResizeObserver(() => {
    for (const { u, place } of panels) u.setSize({ width: Math.max(200, place.clientWidth), height: HEIGHT });
  }).observe(box);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);
  recolor();
  zooming = false;
  return { show, zoom, range: () => range, panels: () => panels.map((panel) => panel.title) };
}

const number = (value) => (Number.isFinite(value) ? value : null);
// Values negligible relative to the panel's range are shown as 0 (choice: above rounding errors).
function formatValue(value, size) {
  if (value === null || value === undefined) return "\u2013";
  if (Math.abs(value) < 1e-5 * size) return "0";
  const whole = Number.isInteger(value);
  return whole || Math.abs(value) >= 100 ? fixed(value, whole ? 0 : 1) : digits3(value);
}
const hex = (color) => (color.startsWith("#") ? color.slice(0, 7) : "#888888");

function span(low, high, zero) {
  if (low === null) return [0, 1];
  const from = zero ? 0 : low;
  const room = 0.08 * (high - from) || Math.abs(high) * 0.1 || 1;
  return [zero ? 0 : from - room, high + room];
}
