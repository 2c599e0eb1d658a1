// Camera images of the nearest frame, with the object's axes and points drawn in.

import { make, readable } from "./data.js";

const AXES = ["x", "y", "z"];

export function makeStills(box, data, images) {
  box.classList.toggle("one", data.cameras.length === 1);
  box.classList.toggle("many", data.cameras.length > 4);
  const nowhere = -32768;
  const tiles = data.cameras.map((name, c) => {
    const [w, h] = data.sizes[c];
    const picture = make("img", { alt: "", draggable: "false", decoding: "async" });
    const points = make("path", { class: "points" });
    const axes = AXES.flatMap((axis) => [make("path", { class: "casing" }), make("path", { class: axis })]);
    const svg = make("svg", { viewBox: `0 0 ${w} ${h}`, "aria-hidden": "true" }, points, ...axes);
    const none = make("p", { class: "none", hidden: "" }, "no image");
    const swatch = make("i", {});
    const words = make("span", { class: "count" }, "");
    const frame = make("div", { class: "frame" }, picture, svg, none);
    frame.style.aspectRatio = `${w} / ${h}`;
    box.append(make("figure", {}, frame, make("figcaption", {}, make("b", {}, swatch, name), words)));
    return { picture, points, axes, svg, none, words, swatch, w, h, name, c };
  });

  function place(array, at, tile) {
    const x = array[2 * at];
    if (x === nowhere) return null;
    return [((x / images.grain) * tile.w).toFixed(1), ((array[2 * at + 1] / images.grain) * tile.h).toFixed(1)];
  }

  function line(array, first, count, tile) {
    let path = "";
    for (let k = 0; k < count; k++) {
      const at = place(array, first + k, tile);
      if (at) path += `${path ? "L" : "M"}${at[0]} ${at[1]}`;
    }
    return path;
  }

  const source = (j, c) => {
    const file = images.files[j]?.[c];
    return file ? `data:image/jpeg;base64,${file}` : null;
  };

  let shown = -1;
  function show(j) {
    if (j === shown || j < 0) return;
    shown = j;
    for (const tile of tiles) {
      const { c } = tile;
      const from = source(j, c);
      tile.picture.hidden = !from;
      tile.none.hidden = Boolean(from);
      tile.svg.style.display = from ? "" : "none";
      if (from) tile.picture.src = from;
      tile.picture.alt = `${tile.name}, frame ${images.index[j]}`;
      const first = (j * data.cameras.length + c) * 3 * images.perAxis;
      AXES.forEach((_, k) => {
        const path = line(images.axes, first + k * images.perAxis, images.perAxis, tile);
        tile.axes[2 * k].setAttribute("d", path);
        tile.axes[2 * k + 1].setAttribute("d", path);
      });
      let dots = "";
      const begin = (j * data.cameras.length + c) * images.perImage;
      for (let k = 0; k < images.perImage; k++) {
        const at = place(images.points, begin + k, tile);
        if (at) dots += `M${at[0]} ${at[1]}h0`;
      }
      tile.points.setAttribute("d", dots);
    }
  }

  function count(k) {
    const n = data.cameras.length;
    for (const { c, words } of tiles) {
      const inliers = data.inliers[k * n + c];
      const matches = data.matches[k * n + c];
      const residual = data.residuals[k * n + c];
      const parts = [];
      if (Number.isFinite(inliers)) parts.push(Number.isFinite(matches) ? `${inliers} of ${matches} matches` : `${inliers} inliers`);
      if (Number.isFinite(residual)) parts.push(`${residual.toFixed(2)} px`);
      if (data.doubt[k * n + c] > 2) parts.push("disagrees");
      words.textContent = parts.join(", ");
      words.classList.toggle("doubted", data.doubt[k * n + c] > 2);
    }
  }

  function recolor() {
    for (const { swatch, c } of tiles) swatch.style.background = readable(data.colors[c]);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);
  recolor();
  return { show, count, sources: (j) => data.cameras.map((_, c) => source(j, c)) };
}
