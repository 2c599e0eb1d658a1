// The page's numbers: JSON with arrays in base64 (src/sylpose/report/page_data.py writes it).

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const floats = (text) => new Float32Array(bytes(text));
const ints = (text) => new Int32Array(bytes(text));
const shorts = (text) => new Int16Array(bytes(text));
const parsed = (id) => JSON.parse(document.getElementById(id).textContent);

const FLOATS = [
  "time", "place", "turned", "sigma", "angle", "turn", "inliers", "residuals", "matches", "doubt", "sheets", "eyes",
  "looks", "points",
];
const INTS = ["index", "status", "reason", "fault", "pointCameras"];

export function readData() {
  const data = parsed("data");
  for (const name of FLOATS) data[name] = floats(data[name]);
  for (const name of INTS) data[name] = ints(data[name]);
  data.n = data.index.length;
  data.hasPose = Array.from({ length: data.n }, (_, k) => Number.isFinite(data.place[3 * k]));
  data.anyPose = data.hasPose.includes(true);
  // Displayed times: large ones, such as seconds since 1970, are relative to the first frame.
  data.times = Array.from(data.time, (t) => data.start - data.since + t);
  data.kinds = Array.from(data.status, (s) => kindOf(data.statuses[s][0], data.statuses[s][2]));
  return data;
}

export function readImages(data) {
  const images = parsed("images-data");
  images.axes = shorts(images.axes);
  images.points = shorts(images.points);
  images.n = images.index.length;
  // Index of the nearest image, by frame of the page.
  images.nearest = Array.from(data.index, (number) => {
    let best = -1;
    images.index.forEach((other, k) => {
      if (best < 0 || Math.abs(other - number) < Math.abs(images.index[best] - number)) best = k;
    });
    return best;
  });
  return images;
}

// Groups of statuses with a color each.
function kindOf(status, hasPose) {
  if (!hasPose) return "none";
  return { relocalised: "again", coasting: "coasting", interpolated: "coasting", uncertain: "uncertain", contradicted: "uncertain", ambiguous: "uncertain" }[status] ?? "tracked";
}

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const kindColor = (kind) => css(`--${kind}`);

// Adapt a color's lightness to be visible on the background, keeping its hue.
export function readable(color) {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  let rgb = [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16) / 255);
  const light = () => 0.2126 * rgb[0] ** 2.2 + 0.7152 * rgb[1] ** 2.2 + 0.0722 * rgb[2] ** 2.2;
  for (let k = 0; k < 20 && (dark ? light() < 0.24 : light() > 0.42); k++) {
    rgb = rgb.map((v) => (dark ? v + 0.08 * (1 - v) + 0.01 : 0.94 * v));
  }
  return `#${rgb.map((v) => Math.round(255 * Math.min(v, 1)).toString(16).padStart(2, "0")).join("")}`;
}

// Create an element with attributes, and text or children; text is never parsed as markup.
export function make(name, attributes = {}, ...children) {
  const svg = ["svg", "path", "circle"].includes(name);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// Format with the given number of decimals; a rounded zero has no sign.
export function fixed(value, digits) {
  if (!Number.isFinite(value)) return "\u2013";
  const text = value.toFixed(digits);
  return text.replace("-", /[1-9]/.test(text) ? "\u2212" : "");
}

// Format with three significant digits.
export function digits3(value) {
  if (!Number.isFinite(value)) return "\u2013";
  if (value === 0) return "0";
  if (Math.abs(value) < 1e-4) return value.toExponential(1).replaceAll("-", "\u2212");
  return fixed(value, Math.min(9, Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value))))));
}
