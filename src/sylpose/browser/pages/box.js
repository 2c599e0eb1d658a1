// The page of `sylpose box`. Coordinates are those of the recorded image from edge to edge: its first pixel is the square
// from (0, 0) to (1, 1), and boxes are [x, y, width, height] in whole pixels.

const CAMERA_COLORS = ["#ffb000", "#38b6ff", "#ff5fa8", "#8fd14f", "#b48cff", "#ff7a45", "#2fd6c3", "#e8e05a"];
const OBJECT_COLORS = ["#00e08a", "#ffd23f", "#ff6b6b", "#4cc9f0", "#c77dff", "#f9844a"];
const DRAG = 4; // screen pixels; a longer movement is a drag
const SIDES = ["nw", "n", "ne", "e", "se", "s", "sw", "w"];

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";

let cameras = []; // {name, width, height, image, color, tile, svg, view}
let boxes = {}; // by object, by camera
let active = ""; // object
let hints = { bands: {}, boxes: {}, wrong: "" }; // for its boxes
let history = [];
let written = "{}"; // content of the file
let drag = null;
let large = null;

// --- requests --------------------------------------------------------------------------------------------------------

async function request(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch {
    throw new Error("The command has ended, so boxes can no longer be saved. Start it again.");
  }
  const value = await response.json();
  if (!response.ok) throw new Error(value.error);
  return value;
}

let pending = null; // until the hints are up to date
let again = false;

function requestHints() {
  again = true;
  $("cameras").ariaBusy = "true";
  pending ??= updateHints();
}

// One request at a time; later changes cause another request.
async function updateHints() {
  while (again) {
    again = false;
    const name = active;
    try {
      const found = await request(`hints?boxes=${encodeURIComponent(JSON.stringify(boxes[name]))}`);
      if (name === active) hints = found;
    } catch (error) {
      hints = { bands: {}, boxes: {}, wrong: error.message };
    }
    draw();
  }
  pending = null;
  $("cameras").ariaBusy = "false";
}

// --- changing ---------------------------------------------------------------------------------------------------------

function remember() {
  history.push(JSON.stringify({ boxes, active }));
  if (history.length > 200) history.shift();
}

function undo() {
  if (!history.length) return;
  ({ boxes, active } = JSON.parse(history.pop()));
  changed();
}

function changed() {
  draw();
  requestHints();
}

function put(camera, box) {
  remember();
  if (box) boxes[active][camera.name] = box;
  else delete boxes[active][camera.name];
  changed();
}

// Take the boxes suggested by the current boxes, which may differ from those still shown; else `otherwise`.
async function take(some, otherwise) {
  await pending;
  const found = some.filter((c) => !boxes[active][c.name] && (hints.boxes[c.name] ?? otherwise));
  if (!found.length) return;
  remember();
  for (const { name } of found) boxes[active][name] = hints.boxes[name] ?? otherwise;
  changed();
}

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function fromEdges(camera, x0, y0, x1, y1) {
  const xs = [x0, x1].map((x) => clamp(Math.round(x), 0, camera.width)).sort((a, b) => a - b);
  const ys = [y0, y1].map((y) => clamp(Math.round(y), 0, camera.height)).sort((a, b) => a - b);
  return [xs[0], ys[0], xs[1] - xs[0], ys[1] - ys[0]];
}

function moved(camera, [x, y, w, h], dx, dy) {
  return [clamp(Math.round(x + dx), 0, camera.width - w), clamp(Math.round(y + dy), 0, camera.height - h), w, h];
}

function resized(camera, [x, y, w, h], side, dx, dy) {
  return fromEdges(
    camera,
    x + (side.includes("w") ? dx : 0),
    y + (side.includes("n") ? dy : 0),
    x + w + (side.includes("e") ? dx : 0),
    y + h + (side.includes("s") ? dy : 0),
  );
}

// --- the pointer ------------------------------------------------------------------------------------------------------

function pointOf(camera, event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(camera.svg.getScreenCTM().inverse());
  return [point.x, point.y];
}

function down(camera, event) {
  if (event.button > 1 || drag) return;
  event.preventDefault();
  camera.svg.focus();
  const { side, object, suggested } = event.target.dataset;
  const box = boxes[active][camera.name];
  drag = { camera, from: pointOf(camera, event), at: [event.clientX, event.clientY], before: box, far: false };
  camera.svg.setPointerCapture(event.pointerId);
  if (event.button === 1 || event.shiftKey) Object.assign(drag, { how: "pan", view: camera.view });
  else if (side) Object.assign(drag, { how: "resize", side });
  else if (object === active) drag.how = "move";
  else Object.assign(drag, { how: "draw", object, suggested });
}

function move(event) {
  if (!drag) return;
  const { camera, from, before } = drag;
  drag.far ||= Math.hypot(event.clientX - drag.at[0], event.clientY - drag.at[1]) >= DRAG;
  if (!drag.far) return;
  if (drag.how === "pan") {
    const scale = camera.svg.getScreenCTM().a;
    const [x, y, w, h] = drag.view;
    look(camera, [x - (event.clientX - drag.at[0]) / scale, y - (event.clientY - drag.at[1]) / scale, w, h]);
    return;
  }
  const [x, y] = pointOf(camera, event);
  if (drag.how === "draw") drag.box = fromEdges(camera, ...from, x, y);
  else if (drag.how === "move") drag.box = moved(camera, before, x - from[0], y - from[1]);
  else drag.box = resized(camera, before, drag.side, x - from[0], y - from[1]);
  if (drag.box[2] < 1 || drag.box[3] < 1) drag.box = undefined;
  show(camera, drag.box ?? before);
}

// Show a box, with hints, while it is dragged.
function show(camera, box) {
  if (box) boxes[active][camera.name] = box;
  else delete boxes[active][camera.name];
  changed();
}

function up(kept) {
  if (!drag) return;
  const { camera, before, box, object, suggested, far, how } = drag;
  drag = null;
  if (how === "pan") return;
  if (far) show(camera, before);
  if (kept && box) put(camera, box);
  else if (kept && !far && suggested) take([camera]);
  else if (kept && !far && object && object !== active) choose(object);
}

function zoom(camera, event) {
  event.preventDefault();
  const [x, y] = pointOf(camera, event);
  const factor = Math.exp(clamp(event.deltaY, -200, 200) / 400);
  const width = clamp(camera.view[2] * factor, Math.min(16, camera.width), camera.width);
  const by = width / camera.view[2];
  look(camera, [x - (x - camera.view[0]) * by, y - (y - camera.view[1]) * by, width, (width * camera.height) / camera.width]);
}

function look(camera, [x, y, w, h]) {
  camera.view = [clamp(x, 0, camera.width - w), clamp(y, 0, camera.height - h), w, h];
  camera.svg.setAttribute("viewBox", camera.view.join(" "));
  camera.tile.classList.toggle("zoomed", camera.svg.getScreenCTM()?.a > 3);
  drawTile(camera);
}

// --- the keyboard -----------------------------------------------------------------------------------------------------

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function key(camera, event) {
  if (event.ctrlKey || event.metaKey) return;
  const box = boxes[active][camera.name];
  const arrow = ARROWS[event.key];
  if (arrow) {
    if (box) {
      const [dx, dy] = arrow.map((d) => d * (event.shiftKey ? 10 : 1));
      const next = event.altKey ? resized(camera, box, "se", dx, dy) : moved(camera, box, dx, dy);
      if (next[2] > 0 && next[3] > 0) put(camera, next);
    }
  } else if (event.key === "Delete" || event.key === "Backspace") {
    if (box) put(camera, null);
  } else if (event.key === "Enter") {
    // Without a mouse, a box starts in the middle.
    const { width: w, height: h } = camera;
    const middle = [Math.round(w / 3), Math.round(h / 3), Math.round(w / 3), Math.round(h / 3)];
    take([camera], middle);
  } else if (event.key === "Escape") up(false);
  else if (event.key === "f" || event.key === "F") enlarge(camera);
  else if (event.key === "0") look(camera, [0, 0, camera.width, camera.height]);
  else return;
  event.preventDefault();
}

// --- objects ----------------------------------------------------------------------------------------------------------

function choose(name) {
  active = name;
  hints = { bands: {}, boxes: {}, wrong: "" };
  changed();
}

function addObject() {
  let number = Object.keys(boxes).length + 1;
  while (boxes[`object_${number}`]) number += 1;
  remember();
  boxes[`object_${number}`] = {};
  choose(`object_${number}`);
  $("objects").querySelector("[aria-selected=true] input").select();
}

function rename(before, after) {
  if (!after || after === before) return draw();
  if (boxes[after]) return say(`There is already an object ${after}.`, true);
  remember();
  boxes = Object.fromEntries(Object.entries(boxes).map(([name, its]) => [name === before ? after : name, its]));
  if (active === before) active = after;
  changed();
}

function removeObject(name) {
  remember();
  delete boxes[name];
  if (active === name) active = Object.keys(boxes)[0];
  choose(active);
}

function drawObjects() {
  const names = Object.keys(boxes);
  const typing = $("objects").contains(document.activeElement) && document.activeElement.tagName === "INPUT";
  if (typing && $("objects").dataset.shown === names.join(" ")) {
    for (const chip of $("objects").querySelectorAll(".object")) {
      chip.setAttribute("aria-selected", chip.dataset.name === active);
      chip.querySelector(".count").textContent = count(chip.dataset.name);
    }
    return;
  }
  const chips = names.map((name, k) => {
    const chip = document.createElement("div");
    chip.className = "object";
    chip.dataset.name = name;
    chip.setAttribute("aria-selected", name === active);
    const dot = document.createElement("span");
    dot.className = "dot";
    dot.style.background = colorOf(k);
    const input = document.createElement("input");
    Object.assign(input, { value: name, spellcheck: false, title: "The object's name", ariaLabel: "The object's name" });
    input.addEventListener("change", () => rename(name, input.value.trim()));
    input.addEventListener("keydown", (event) => event.key === "Enter" && input.blur());
    const number = document.createElement("span");
    number.className = "count";
    number.textContent = count(name);
    chip.append(dot, input, number);
    if (names.length > 1) {
      const remove = document.createElement("button");
      Object.assign(remove, { textContent: "×", title: `Remove ${name}` });
      remove.addEventListener("click", (event) => (event.stopPropagation(), removeObject(name)));
      chip.append(remove);
    }
    chip.addEventListener("click", () => name !== active && choose(name));
    return chip;
  });
  const add = document.createElement("button");
  Object.assign(add, { textContent: "+ object", title: "Add an object; each object is tracked separately" });
  add.addEventListener("click", addObject);
  $("objects").replaceChildren(...chips, add);
  $("objects").dataset.shown = names.join(" ");
}

const count = (name) => `${Object.keys(boxes[name]).length}/${cameras.length}`;
const colorOf = (k) => OBJECT_COLORS[k % OBJECT_COLORS.length];

// --- drawing ----------------------------------------------------------------------------------------------------------

function shape(kind, { color, ...attributes }, parent) {
  const element = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (color) element.style.setProperty("--of", color);
  parent.append(element);
  return element;
}

function rectangle([x, y, width, height], parent, attributes) {
  shape("rect", { x, y, width, height, class: "halo" }, parent);
  return shape("rect", { x, y, width, height, class: "box", ...attributes }, parent);
}

function drawTile(camera) {
  if (!camera.image) return;
  const { svg, tile } = camera;
  const pixel = 1 / (svg.getScreenCTM()?.a || 1); // a screen pixel in image pixels
  const names = Object.keys(boxes);
  const own = boxes[active]?.[camera.name];
  const layers = Object.fromEntries([...svg.querySelectorAll("g")].map((g) => [g.getAttribute("class"), g]));
  for (const layer of Object.values(layers)) layer.replaceChildren();

  for (const { of, outline, middle } of hints.bands[camera.name] ?? []) {
    const { color } = cameras.find((c) => c.name === of);
    const points = (line) => line.map((p) => p.join(",")).join(" ");
    if (outline.length) shape("polygon", { points: points(outline), color, "data-of": of }, layers.bands);
    if (middle.length) shape("polyline", { points: points(middle), color, "data-of": of }, layers.bands);
  }
  names.forEach((name, k) => {
    const box = boxes[name][camera.name];
    if (!box || name === active) return;
    rectangle(box, layers.others, { "data-object": name, color: colorOf(k) });
    const label = shape("text", { "font-size": 0 }, layers.others);
    label.textContent = name;
    label.style.fontSize = `${13 * pixel}px`;
    label.style.strokeWidth = `${3 * pixel}px`;
    label.setAttribute("x", box[0] + 3 * pixel);
    label.setAttribute("y", box[1] - 5 * pixel > 12 * pixel ? box[1] - 5 * pixel : box[1] + 15 * pixel);
  });
  const color = colorOf(names.indexOf(active));
  const suggested = !own && hints.boxes[camera.name];
  if (suggested) rectangle(suggested, layers.suggested, { "data-suggested": "yes", color });
  if (own) {
    const [x, y, w, h] = own;
    rectangle(own, layers.own, { "data-object": active, color });
    for (const side of SIDES) {
      // Small boxes have handles at their corners only.
      if (side.length === 1 && (side === "n" || side === "s" ? w : h) < 40 * pixel) continue;
      const cx = side.includes("w") ? x : side.includes("e") ? x + w : x + w / 2;
      const cy = side.includes("n") ? y : side.includes("s") ? y + h : y + h / 2;
      for (const [size, kind] of [[9, "handle"], [16, "grip"]]) {
        const s = size * pixel;
        const place = { x: cx - s / 2, y: cy - s / 2, width: s, height: s };
        shape("rect", { ...place, class: kind, "data-side": side }, layers.own);
      }
    }
  }
  tile.classList.toggle("known", Boolean(own));
  tile.classList.toggle("met", Boolean(suggested));
  tile.querySelector(".remove").hidden = !own;
  tile.querySelector(".numbers").textContent = own
    ? `${own[2]} × ${own[3]} px at ${own[0]}, ${own[1]}`
    : suggested
      ? "click the dashed box to accept it"
      : "";
  svg.setAttribute("aria-label", `${camera.name}: ${own ? `box ${own.join(", ")}` : "no box"}`);
}

function draw() {
  cameras.forEach(drawTile);
  drawObjects();
  const suggested = cameras.filter((c) => hints.boxes[c.name] && !boxes[active][c.name]).length;
  $("take").hidden = suggested === 0;
  $("take").textContent = suggested === 1 ? "Accept the suggested box" : `Accept ${suggested} suggested boxes`;
  $("undo").disabled = !history.length;
  if (hints.wrong) say(sentence(hints.wrong), true);
  else say(guidance(suggested));
}

function sentence(words) {
  const meet = words.match(/the boxes of (.*) do not intersect in space/);
  return meet ? `The boxes of ${meet[1]} do not intersect in space, so they cannot contain the same object.` : words;
}

function guidance(suggested) {
  const known = Object.keys(boxes[active]).length;
  if (!known) return "Drag a box around the object in any camera; rather too large than too small.";
  if (cameras.length === 1) return "Save the box.";
  if (known === 1) return "Now drag a box in a second camera: the object is inside the band. Skip cameras that do not see it.";
  if (suggested) return "Dashed boxes are suggestions from the other boxes: click to accept them, or draw your own.";
  return "Save the boxes. Cameras that do not see the object need none.";
}

function say(words, wrong = false) {
  $("say").textContent = words;
  $("say").classList.toggle("wrong", wrong);
}

// --- the layout -------------------------------------------------------------------------------------------------------

const BAR = 34;
const GAP = 10;

function enlarge(camera) {
  large = large === camera ? null : camera;
  arrange();
  camera.svg.focus();
}

// Use the number of columns with the largest images; or show one large image with the others next to it.
function arrange() {
  const main = $("cameras");
  const width = main.clientWidth - 32;
  const height = main.clientHeight - 2;
  const ratio = (camera) => camera.width / camera.height;
  const widest = Math.max(...cameras.map(ratio));
  for (const camera of cameras) {
    camera.tile.removeAttribute("style");
    camera.tile.querySelector(".large").textContent = camera === large ? "Show all" : "Enlarge";
  }
  main.style.gridTemplateRows = large && cameras.length > 2 ? `repeat(${cameras.length - 2}, max-content) 1fr` : "";
  if (large) {
    const strip = clamp(width * 0.22, 180, 360);
    main.style.gridTemplateColumns = `${width - strip - GAP}px ${strip}px`;
    for (const camera of cameras) {
      const { style } = camera.tile;
      if (camera === large) {
        style.gridArea = `1 / 1 / span ${Math.max(1, cameras.length - 1)} / 2`;
        style.height = `${height}px`;
        style.position = "sticky";
        style.top = "0";
      } else {
        style.gridColumn = "2";
        style.height = `${strip / ratio(camera) + BAR}px`;
      }
    }
  } else {
    let best = { image: 0 };
    for (let columns = 1; columns <= cameras.length; columns += 1) {
      const rows = Math.ceil(cameras.length / columns);
      const across = (width - GAP * (columns - 1)) / columns;
      const down = (height - GAP * (rows - 1)) / rows - BAR;
      const image = Math.min(across, down * widest);
      if (image > best.image) best = { image, columns };
    }
    // Scroll rather than shrink images too far to draw in.
    const image = Math.max(best.image, Math.min(360, width));
    const columns = best.image >= image ? best.columns : Math.max(1, Math.floor((width + GAP) / (image + GAP)));
    main.style.gridTemplateColumns = `repeat(${columns}, ${image}px)`;
    for (const { tile } of cameras) tile.style.height = `${image / widest + BAR}px`;
  }
  draw();
}

function build(camera, k) {
  const tile = $("tile").content.firstElementChild.cloneNode(true);
  const svg = tile.querySelector("svg");
  Object.assign(camera, { tile, svg, color: CAMERA_COLORS[k % CAMERA_COLORS.length], view: [0, 0, camera.width, camera.height] });
  tile.dataset.camera = camera.name;
  tile.querySelector(".name").textContent = camera.name;
  tile.querySelector(".dot").style.background = camera.color;
  svg.setAttribute("viewBox", camera.view.join(" "));
  if (camera.image) {
    const picture = svg.querySelector("image");
    picture.setAttribute("width", camera.width);
    picture.setAttribute("height", camera.height);
    picture.setAttribute("href", `image?camera=${encodeURIComponent(camera.name)}`);
    svg.addEventListener("pointerdown", (event) => down(camera, event));
    svg.addEventListener("pointermove", move);
    svg.addEventListener("pointerup", () => up(true));
    svg.addEventListener("pointercancel", () => up(false));
    svg.addEventListener("wheel", (event) => zoom(camera, event), { passive: false });
    svg.addEventListener("keydown", (event) => key(camera, event));
  } else {
    tile.classList.add("blank");
    svg.removeAttribute("tabindex");
    tile.querySelector(".none").hidden = false;
  }
  tile.querySelector(".remove").addEventListener("click", () => put(camera, null));
  tile.querySelector(".large").addEventListener("click", () => enlarge(camera));
  $("cameras").append(tile);
}

// --- start and save --------------------------------------------------------------------------------------------------

async function save() {
  $("save").disabled = true;
  try {
    // The command ends after saving and accepts no more requests.
    await pending;
    const { file, next } = await request("boxes", { method: "POST", body: JSON.stringify(boxes) });
    written = JSON.stringify(boxes);
    $("file").textContent = `The boxes were written to ${file}.`;
    $("next").textContent = next;
    $("saved").showModal();
  } catch (error) {
    say(error.message, true);
    $("save").disabled = false;
  }
}

$("save").addEventListener("click", save);
$("undo").addEventListener("click", undo);
$("take").addEventListener("click", () => take(cameras));
addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.target.tagName === "INPUT") return;
  if (event.key === "z") undo();
  else if (event.key === "s") save();
  else return;
  event.preventDefault();
});
addEventListener("resize", arrange);
addEventListener("beforeunload", (event) => JSON.stringify(boxes) !== written && event.preventDefault());

try {
  const state = await request("state");
  ({ cameras, boxes } = state);
  written = JSON.stringify(boxes);
  active = Object.keys(boxes)[0];
  document.title = `${state.recording}: boxes`;
  $("recording").textContent = `${state.recording}, frame ${state.frame}`;
  cameras.forEach(build);
  arrange();
  requestHints();
  cameras.find((camera) => camera.image)?.svg.focus();
} catch (error) {
  say(error.message, true);
}
