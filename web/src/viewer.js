// 3D view of the rig, the object and its path. Lengths are normalized by the cameras' distance (`reach`).

import {
  BufferGeometry, CanvasTexture, Color, DoubleSide, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, PerspectiveCamera, Points, PointsMaterial, Ray, Scene, SphereGeometry, SRGBColorSpace, Texture, Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { css, digits3, kindColor, make, readable } from "./data.js";

// Vertical field of view, degrees.
const FIELD = 38;
const AXIS_VARIABLES = ["--x", "--y", "--z"];

export function makeViewer(box, data, images) {
  const scale = 1 / data.reach;
  const [right, ahead, up] = data.axes.map((row) => new Vector3(...row));
  const vector = (array, k) => new Vector3(array[3 * k], array[3 * k + 1], array[3 * k + 2]).multiplyScalar(scale);
  const eyes = data.cameras.map((_, c) => vector(data.eyes, c));
  // Far plane of each camera's frustum, by rows, with lens distortion removed.
  const g = data.grid;
  const sheets = data.cameras.map((_, c) => Array.from({ length: g * g }, (__, k) => vector(data.sheets, g * g * c + k)));
  const corners = sheets.map((sheet) => [0, g - 1, g * g - 1, g * (g - 1)].map((k) => sheet[k]));
  const places = data.hasPose.map((has, k) => (has ? vector(data.place, k) : null));
  const radius = data.axisLength * scale;

  const renderer = new WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  const canvas = renderer.domElement;
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `Cameras and object in three dimensions; ${data.cameras.length} cameras`);
  const labels = make("div", { class: "labels", "aria-hidden": "true" });
  box.prepend(canvas, labels);

  const world = new Scene();
  const eye = new PerspectiveCamera(FIELD, 1, 0.002, 200);
  eye.up.copy(up);
  const controls = new OrbitControls(eye, canvas);
  // The wheel scrolls the page until the view is clicked.
  controls.enableZoom = false;
  canvas.addEventListener("focus", () => (controls.enableZoom = true));
  canvas.addEventListener("blur", () => (controls.enableZoom = false));
  canvas.style.touchAction = "pan-y"; // so that a finger can scroll past it
  canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));

  const named = [];
  // --- static parts ----------------------------------------------------------------------------------------------------
  // The view is fitted to measured poses; predicted ones may be anywhere.
  const sure = places.filter((p, k) => p && ["tracked", "again"].includes(data.kinds[k]));
  const standing = [...eyes, ...corners.flat(), ...sure, new Vector3()];
  const far = Math.max(...standing.map((p) => p.length()), 3 * radius);
  const low = Math.min(...sure.map((p) => p.dot(up)), 0) - 1.15 * radius;
  const steps = 10 ** Math.floor(Math.log10(far / scale / 4));
  const spacing = [5, 2, 1].map((m) => m * steps).find((s) => far / scale / s >= 4) ?? steps;
  const cells = Math.ceil(far / scale / spacing);

  const floor = new Group();
  for (const [name, opacity] of [["--grid", 1]]) {
    const points = [];
    for (let k = -cells; k <= cells; k++) {
      for (const [along, across] of [[right, ahead], [ahead, right]]) {
        for (const end of [-cells, cells]) {
          const at = across.clone().multiplyScalar(k * spacing * scale).addScaledVector(along, end * spacing * scale);
          points.push(...at.addScaledVector(up, low).toArray());
        }
      }
    }
    const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
    floor.add(new LineSegments(geometry, new LineBasicMaterial({ transparent: true, opacity, depthWrite: false })));
    floor.children.at(-1).userData.color = () => css(name);
  }
  world.add(floor);

  const materials = [];
  function lines(pairs, width, color, options = {}) {
    const geometry = new LineSegmentsGeometry().setPositions(pairs.flatMap((p) => p.toArray()));
    const material = new LineMaterial({ linewidth: width, transparent: true, ...options });
    materials.push([material, color]);
    return new LineSegments2(geometry, material);
  }

  const origin = new Vector3(...data.center).multiplyScalar(-scale);
  const originNear = origin.length() < 1.5 * far;
  if (originNear) {
    const length = 0.5 * spacing * scale;
    for (let k = 0; k < 3; k++) {
      const end = origin.clone().setComponent(k, origin.getComponent(k) + length);
      world.add(lines([origin, end], 1.6, () => css(AXIS_VARIABLES[k])));
      label("xyz"[k], end, "axis");
    }
    label("world", origin, "axis");
  }

  const pictures = data.cameras.map((name, c) => {
    const o = eyes[c];
    const sheet = sheets[c];
    const edges = corners[c].flatMap((corner) => [o, corner]);
    for (let k = 0; k + 1 < g; k++) {
      for (const [from, step] of [[0, 1], [g * (g - 1), 1], [0, g], [g - 1, g]]) {
        edges.push(sheet[from + k * step], sheet[from + (k + 1) * step]);
      }
    }
    world.add(lines(edges, 1.8, () => readable(data.colors[c])));
    const behind = new Vector3(data.looks[3 * c], data.looks[3 * c + 1], data.looks[3 * c + 2]).multiplyScalar(-0.02);
    label(name, o.clone().add(behind), "camera", c);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute(sheet.flatMap((p) => p.toArray()), 3));
    geometry.setAttribute("uv", new Float32BufferAttribute(sheet.flatMap((_, k) => [(k % g) / (g - 1), 1 - Math.floor(k / g) / (g - 1)]), 2));
    geometry.setIndex(sheet.flatMap((_, k) => (k % g < g - 1 && k < g * (g - 1) ? [k, k + g, k + 1, k + 1, k + g, k + g + 1] : [])));
    const mesh = new Mesh(geometry, new MeshBasicMaterial({ side: DoubleSide, transparent: true, opacity: 0.92 }));
    mesh.visible = false;
    world.add(mesh);
    return mesh;
  });

  // The path, in the colors of the frames' statuses.
  const pairs = [];
  const wayKinds = [];
  places.forEach((place, k) => {
    if (k > 0 && place && places[k - 1]) {
      pairs.push(places[k - 1], place);
      wayKinds.push(data.kinds[k]);
    }
  });
  const way = pairs.length ? lines(pairs, 2.6, () => "#ffffff", { vertexColors: true }) : null;
  if (way) world.add(way);

  // --- the object -------------------------------------------------------------------------------------------------------
  const object = new Group();
  object.matrixAutoUpdate = false;
  world.add(object);
  const dot = make("canvas", { width: 32, height: 32 });
  const pen = dot.getContext("2d");
  pen.fillStyle = "#fff";
  pen.arc(16, 16, 14, 0, 7);
  pen.fill();
  let cloud = null;
  if (data.points.length) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute(data.points.map((v) => v * scale), 3));
    geometry.setAttribute("color", new Float32BufferAttribute(data.points.length, 3));
    const material = new PointsMaterial({
      sizeAttenuation: false, vertexColors: true, map: new CanvasTexture(dot), alphaTest: 0.5, transparent: true,
    });
    cloud = new Points(geometry, material);
    object.add(cloud);
  }
  for (let k = 0; k < 3; k++) {
    const end = new Vector3().setComponent(k, 1.25 * radius);
    object.add(lines([new Vector3(), end], 4, () => css(AXIS_VARIABLES[k])));
  }

  // Two standard deviations along the world's axes, enlarged by a power of ten to be visible.
  const sizes = places.map((p, k) => (p ? Math.max(...[3, 4, 5].map((j) => data.sigma[6 * k + j])) : NaN));
  const known = sizes.filter((s) => s > 0).sort((a, b) => a - b);
  const usual = known[Math.floor(0.9 * known.length)] ?? 0;
  const larger = usual > 0 ? Math.max(1, 10 ** Math.floor(Math.log10((0.7 * data.axisLength) / (2 * usual)))) : 1;
  const uncertaintyEllipsoid = new Mesh(
    new SphereGeometry(1, 40, 20), new MeshBasicMaterial({ transparent: true, opacity: 0.28, depthWrite: false }),
  );
  uncertaintyEllipsoid.userData.color = () => css("--accent");
  world.add(uncertaintyEllipsoid);

  // --- labels, colors, sizes --------------------------------------------------------------------------------------------
  function label(text, at, kind, c) {
    const element = make("span", { class: kind }, text);
    labels.append(element);
    named.push({ element, at, c });
  }

  function recolor() {
    for (const [material, color] of materials) material.color.set(color());
    world.traverse((o) => o.userData.color && o.material.color.set(o.userData.color()));
    for (const { element, c } of named) if (c !== undefined) element.style.color = readable(data.colors[c]);
    if (way) {
      const colors = wayKinds.flatMap((kind) => [0, 1].flatMap(() => new Color(kindColor(kind)).toArray()));
      way.geometry.setColors(colors);
    }
    if (cloud) {
      const colors = data.colors.map((color) => new Color(readable(color)).toArray());
      const all = cloud.geometry.getAttribute("color");
      data.pointCameras.forEach((c, k) => all.setXYZ(k, ...colors[c]));
      all.needsUpdate = true;
    }
    draw();
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      if (cloud) {
        const pixels = (0.08 * radius * canvas.clientHeight) / eye.position.distanceTo(object.position.setFromMatrixPosition(object.matrix));
        cloud.material.size = Math.min(7, Math.max(2.8, pixels)) * renderer.getPixelRatio();
      }
      renderer.render(world, eye);
      const { clientWidth: w, clientHeight: h } = canvas;
      for (const { element, at } of named) {
        const p = at.clone().project(eye);
        element.hidden = p.z > 1 || Math.abs(p.x) > 1.05 || Math.abs(p.y) > 1.05;
        element.style.transform = `translate(-50%, -130%) translate(${(0.5 + 0.5 * p.x) * w}px, ${(0.5 - 0.5 * p.y) * h}px)`;
      }
    });
  }
  controls.addEventListener("change", draw);

  // Place the eye on the given side, looking at the center, as near as a margin around all points allows.
  function stand(seen, back) {
    const side = new Vector3().crossVectors(up, back).normalize();
    const over = new Vector3().crossVectors(back, side);
    const span = (v) => seen.map((p) => p.dot(v)).reduce(([a, b], x) => [Math.min(a, x), Math.max(b, x)], [Infinity, -Infinity]);
    const target = new Vector3();
    for (const v of [side, over, back]) target.addScaledVector(v, span(v).reduce((a, b) => a + b) / 2);
    const slope = 0.84 * Math.tan((0.5 * FIELD * Math.PI) / 180);
    const away = Math.max(...seen.map((p) => {
      const from = p.clone().sub(target);
      return from.dot(back) + Math.max(Math.abs(from.dot(side)) / eye.aspect, Math.abs(from.dot(over))) / slope;
    }));
    return { target, from: target.clone().addScaledVector(back, away) };
  }

  // Count points around the object, at some path positions, that the cameras' images hide from an eye position.
  const some = sure.length ? [0, 0.5, 1].map((t) => sure[Math.round(t * (sure.length - 1))]) : [new Vector3()];
  const rim = some.flatMap((p) => [right, ahead, up].flatMap((v) => [-1, 0, 1].map((s) => p.clone().addScaledVector(v, s * radius))));
  function hidden(from) {
    const line = new Ray();
    const met = new Vector3();
    return rim.filter((p) => {
      line.set(from, p.clone().sub(from).normalize());
      return corners.some(([a, b, c, d]) => [[a, b, c], [a, c, d]].some((three) => (
        line.intersectTriangle(...three, false, met) && met.distanceTo(from) < p.distanceTo(from))));
    }).length;
  }

  // Viewing directions to try, around from the front and then from higher up; the first one with the least occlusion by
  // images is chosen.
  const sides = [0.88, 1.6, 3].flatMap((height) => [0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6].map((k) => {
    const around = Math.atan2(0.36, 0.8) + (k * Math.PI) / 6;
    return ahead.clone().multiplyScalar(-Math.cos(around)).addScaledVector(right, Math.sin(around)).addScaledVector(up, height).normalize();
  }));
  function best(seen) {
    let least = Infinity;
    let found = null;
    for (const back of sides) {
      const place = stand(seen, back);
      const much = images.n ? hidden(place.from) : 0;
      if (much < least) [least, found] = [much, place];
      if (!much) break;
    }
    return found;
  }

  function fit(view = "all") {
    const near = view === "object" && places[current];
    const seen = near ? [-1, 1].flatMap((s) => [right, ahead, up].map((v) => near.clone().addScaledVector(v, 1.6 * s * radius))) : standing;
    const place = view === "above" ? stand(seen, up.clone().addScaledVector(ahead, -1e-3).normalize()) : best(seen);
    controls.target.copy(place.target);
    eye.position.copy(place.from);
    const c = view.startsWith("camera ") ? Number(view.slice(7)) : -1;
    eye.up.copy(up);
    eye.fov = FIELD;
    if (c >= 0) through(c);
    // In a camera's view, its image is behind everything else.
    pictures.forEach((mesh, k) => {
      mesh.renderOrder = k === c ? -1 : 0;
      mesh.material.depthTest = mesh.material.depthWrite = k !== c;
    });
    eye.updateProjectionMatrix();
    controls.update();
    draw();
  }

  // Look through a camera, with its whole image in the view.
  function through(c) {
    const [a, b, , d] = corners[c];
    const look = vector(data.looks, c).multiplyScalar(data.reach);
    const deep = a.clone().sub(eyes[c]).dot(look);
    eye.position.copy(eyes[c]);
    eye.up.copy(a).sub(d).normalize();
    eye.fov = (360 / Math.PI) * Math.atan((0.52 * Math.max(a.distanceTo(d), a.distanceTo(b) / eye.aspect)) / deep);
    controls.target.copy(eyes[c]).addScaledVector(look, 1);
  }

  function resize() {
    const { clientWidth: w, clientHeight: h } = box;
    if (!w || !h) return;
    renderer.setSize(w, h, false);
    eye.aspect = w / h;
    eye.updateProjectionMatrix();
    draw();
  }

  // --- moving parts -----------------------------------------------------------------------------------------------------
  let current = -1;
  function show(k) {
    current = k;
    const has = data.hasPose[k];
    const from = has ? k : data.hasPose.lastIndexOf(true, k);
    object.visible = from >= 0;
    if (from >= 0) {
      const r = data.turned.subarray(9 * from, 9 * from + 9);
      const { x, y, z } = places[from];
      object.matrix.set(r[0], r[1], r[2], x, r[3], r[4], r[5], y, r[6], r[7], r[8], z, 0, 0, 0, 1);
      object.matrixWorldNeedsUpdate = true;
    }
    // Without a pose, the last one is shown pale.
    object.traverse((o) => o.material && (o.material.opacity = has ? 1 : 0.18));
    const sigma = [3, 4, 5].map((j) => data.sigma[6 * k + j] * 2 * larger * scale);
    uncertaintyEllipsoid.visible = has && sigma.every((s) => s > 0 && s < far);
    if (uncertaintyEllipsoid.visible) {
      uncertaintyEllipsoid.position.copy(places[k]);
      uncertaintyEllipsoid.scale.set(...sigma);
    }
    draw();
  }

  const wanted = { still: -1 };
  function showStill(j, sources) {
    if (wanted.still === j) return;
    wanted.still = j;
    sources.forEach((source, c) => {
      const mesh = pictures[c];
      if (!source) {
        mesh.visible = false;
        return;
      }
      const image = new Image();
      image.onload = () => {
        if (wanted.still !== j) return;
        const texture = new Texture(image);
        texture.colorSpace = SRGBColorSpace;
        texture.needsUpdate = true;
        mesh.material.map?.dispose();
        mesh.material.map = texture;
        mesh.material.needsUpdate = !mesh.visible;
        mesh.visible = true;
        draw();
      };
      image.src = source;
    });
  }

  new ResizeObserver(resize).observe(box);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);
  resize();
  recolor();
  fit();
  const legend = [`grid ${digits3(spacing)} ${data.unit}`];
  if (usual > 0) legend.push(`ellipsoid: \u00b1 2 standard deviations${larger > 1 ? `, ${larger} times as large` : ""}`);
  if (!originNear) legend.push("the world's origin is out of view");
  return { show, showStill, fit, legend, matrix: () => object.matrix.toArray(), visible: () => object.visible, hidden: () => hidden(eye.position) };
}
