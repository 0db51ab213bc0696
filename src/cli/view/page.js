// The page: which picture, which view, and what the pointer stands on.
import { colours, cross, overlay, range, unpack, words } from "./map.js";
import { cloud } from "./cloud.js";

const by = (id) => document.getElementById(id);
const [stage, message, readout] = [by("stage"), by("message"), by("readout")];
let state, picture = null, at = [0.5, 0.6], busy = 0, playing = null;
/** Of each weights: the map, what a pixel looks at, the canvas, and the points once they were shown. */
let panes = [];
let shown = null; // the picture's pixels

const view = () => document.querySelector("input[name=view]:checked").value;
const say = (text, bad = false) => {
  message.textContent = text;
  message.classList.toggle("bad", bad);
};

async function ask(path, options) {
  let reply;
  try {
    reply = await fetch(path, options);
  } catch {
    throw new Error("the program does not answer: was it ended?");
  }
  if (!reply.ok) {
    const why = await reply.json().catch(() => ({ error: reply.statusText }));
    throw new Error(why.error);
  }
  return reply;
}

/** Does something that may fail; only the newest counts. */
async function attempt(text, work) {
  const mine = ++busy;
  say(text);
  try {
    const done = await work(() => mine === busy);
    if (mine === busy) say(done || "");
  } catch (error) {
    if (mine === busy) say(error.message, true);
  }
}

async function pixels(number) {
  const blob = await (await ask("picture/" + number)).blob();
  const bitmap = await createImageBitmap(blob);
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height);
}

function look(number, name) {
  return attempt("computing depth ...", async (current) => {
    const image = await pixels(number);
    const maps = [];
    for (let weights = 0; weights < state.weights.length; weights++) {
      const reply = await ask(`depth/${number}?weights=${weights}`);
      maps.push(unpack(await reply.arrayBuffer()));
    }
    if (!current()) return;
    const same = panes.length > 0 && view() === "points";
    [picture, shown] = [number, image];
    by("name").textContent = name;
    if (same) panes.forEach((pane, i) => Object.assign(pane, { map: maps[i], attention: null, images: {} }));
    else panes = maps.map((map) => ({ map, attention: null, images: {} }));
    if (view() === "attention") await attend(current);
    draw();
    return maps[0].about.doubt || "";
  });
}

/** Asks what the pixel at the cross looks at. */
async function attend(current) {
  for (const [weights, pane] of panes.entries()) {
    const reply = await ask(`attention/${picture}?weights=${weights}&x=${at[0]}&y=${at[1]}`);
    const found = unpack(await reply.arrayBuffer());
    if (!current()) return;
    let from = 0;
    pane.images = {};
    pane.attention = found.about.layers.map((layer) => {
      const numbers = found.values.subarray(from, from + layer.width * layer.height);
      from += numbers.length;
      return { layer, numbers };
    });
  }
  const layers = panes[0].attention;
  const before = by("layer").value;
  by("layer").replaceChildren(...layers.map(({ layer }, i) => {
    const option = document.createElement("option");
    option.value = i;
    option.textContent = `stage ${layer.stage}, path ${layer.path}, layer ${layer.layer}`;
    return option;
  }));
  by("layer").value = before && layers[before] ? before : layers.length - 1;
  if (!layers.length) throw new Error("these networks have no transformer paths: there is no attention to show");
}

function attentionHere() {
  document.querySelector("input[value=attention]").checked = true;
  return attempt("computing what this pixel looks at ...", async (current) => {
    await attend(current);
    draw();
  });
}

function canvasOf(pane, i) {
  const points = view() === "points";
  if (pane.canvas && pane.points === points) return pane.canvas;
  const figure = document.createElement("figure"), caption = document.createElement("figcaption");
  const canvas = document.createElement("canvas");
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.className = points ? "points" : "map";
  if (state.weights.length > 1) caption.textContent = state.weights[i].name;
  figure.append(canvas, caption);
  Object.assign(pane, { canvas, points, figure, cloud: null });
  if (!points) follow(canvas);
  return canvas;
}

function draw() {
  if (picture === null) return;
  const which = view();
  by("layer-label").hidden = which !== "attention";
  by("scale").hidden = which !== "depth";
  panes.forEach((pane, i) => {
    const canvas = canvasOf(pane, i);
    const names = { depth: "Depth map", picture: "Picture", points: "Points in space", attention: "What the pixel at the cross looks at" };
    canvas.setAttribute("aria-label", names[which]);
    if (pane.figure.parentNode !== stage) {
      if (i === 0) stage.replaceChildren();
      stage.append(pane.figure);
    }
    if (which === "points") {
      try {
        if (pane.cloud) pane.cloud(pane.map, shown);
        else pane.cloud = cloud(canvas, pane.map, shown);
      } catch (error) {
        say(error.message, true);
      }
      return;
    }
    const image = imageOf(pane, which);
    if (canvas.width !== image.width || canvas.height !== image.height) {
      [canvas.width, canvas.height] = [image.width, image.height];
    }
    const context = canvas.getContext("2d");
    context.putImageData(image, 0, 0);
    cross(context, at);
  });
  scale();
  read();
}

/** A view of a map, made once: it is drawn again whenever the cross moves. */
function imageOf(pane, which) {
  const chosen = which === "attention" && pane.attention && pane.attention[by("layer").value];
  const name = chosen ? "layer" + by("layer").value : which;
  if (!pane.images[name]) {
    if (which === "depth") pane.images[name] = colours(pane.map, state.palette);
    else if (chosen) pane.images[name] = overlay(shown, chosen.layer, chosen.numbers);
    else return shown;
  }
  return pane.images[name];
}

/** The colours' ends in words. */
function scale() {
  const pane = panes[0], { about } = pane.map, [low, high] = (pane.images.range ||= range(pane.map.values));
  by("near").textContent = words(high, about.unit);
  by("far").textContent = words(low, about.unit);
  const context = by("ramp").getContext("2d");
  const ramp = context.createImageData(256, 1);
  for (let i = 0; i < 256; i++) ramp.data.set([...state.palette[255 - i], 255], 4 * i);
  context.putImageData(ramp, 0, 0);
}

/** Depth at the cross. */
function read() {
  const said = panes.map(({ map: { about, values } }, i) => {
    const x = Math.min(about.width - 1, Math.floor(at[0] * about.width));
    const y = Math.min(about.height - 1, Math.floor(at[1] * about.height));
    const whose = panes.length > 1 ? state.weights[i].name + ": " : "";
    const where = i === 0 ? `column ${x}, row ${y}: ` : "";
    return where + whose + words(values[y * about.width + x], about.unit);
  });
  const { view, view_by } = panes[0].map.about;
  const told = { flag: "as given", camera_toml: "by camera.toml", exif: "by EXIF", assumed: "assumed: --fov says another" }[view_by];
  const known = panes.some((pane) => pane.map.about.unit === "metres");
  readout.textContent = said.join("; ") + (known ? ` (a view of ${view.toFixed(1)} degrees across, ${told})` : "");
}

/** Lets the cross follow the pointer and the keys. */
function follow(canvas) {
  const place = (e) => {
    const box = canvas.getBoundingClientRect();
    const share = (x) => Math.max(0, Math.min(0.9999, x));
    at = [share((e.clientX - box.left) / box.width), share((e.clientY - box.top) / box.height)];
  };
  canvas.addEventListener("pointermove", (e) => {
    place(e);
    // What the pixel that was clicked looks at stays, and so does its cross.
    if (view() === "attention") read();
    else draw();
  });
  canvas.addEventListener("click", (e) => {
    place(e);
    attentionHere();
  });
  canvas.addEventListener("keydown", (e) => {
    const step = (e.shiftKey ? 10 : 1) / canvas.width, down = (e.shiftKey ? 10 : 1) / canvas.height;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -down], ArrowDown: [0, down] };
    if (e.key === "Enter") attentionHere();
    else if (moves[e.key]) {
      at = at.map((x, i) => Math.max(0, Math.min(0.9999, x + moves[e.key][i])));
      draw();
    } else return;
    e.preventDefault();
  });
}

async function take(file) {
  stop();
  await attempt("reading the picture ...", async () => {
    const reply = await ask("pictures", { method: "POST", body: file });
    const { picture } = await reply.json();
    await look(picture, file.name);
    return message.textContent;
  });
}

function film() {
  const count = state.pictures.length;
  by("film").hidden = count < 2;
  by("slider").max = Math.max(0, count - 1);
}

async function go(number) {
  const count = state.pictures.length;
  if (!count) return;
  const to = ((number % count) + count) % count;
  by("slider").value = to;
  by("count").textContent = `${to + 1} of ${count}`;
  by("slider").setAttribute("aria-valuetext", state.pictures[to]);
  await look(to, state.pictures[to]);
}
const step = (by_) => go(Number(by("slider").value) + by_);

function stop() {
  playing = null;
  by("play").textContent = "Play";
  by("play").setAttribute("aria-pressed", "false");
}
async function play() {
  if (playing) return stop();
  const mine = (playing = {});
  by("play").textContent = "Pause";
  by("play").setAttribute("aria-pressed", "true");
  while (playing === mine) {
    const began = performance.now();
    await step(1);
    // Ten pictures a second, if the machine keeps up.
    await new Promise((done) => setTimeout(done, Math.max(0, 100 - (performance.now() - began))));
  }
}

by("file").addEventListener("change", (e) => e.target.files[0] && take(e.target.files[0]));
by("previous").addEventListener("click", () => { stop(); step(-1); });
by("next").addEventListener("click", () => { stop(); step(1); });
by("play").addEventListener("click", play);
by("slider").addEventListener("input", () => { stop(); go(Number(by("slider").value)); });
by("layer").addEventListener("change", draw);
for (const radio of document.querySelectorAll("input[name=view]")) {
  radio.addEventListener("change", () => {
    if (view() === "attention" && picture !== null && !panes[0].attention) attentionHere();
    else draw();
  });
}
document.addEventListener("keydown", (e) => {
  const elsewhere = e.target.closest("input,select,button,summary");
  if (e.key === "PageUp" || e.key === "PageDown") { stop(); step(e.key === "PageUp" ? -1 : 1); }
  else if (e.key === " " && !elsewhere && state.pictures.length > 1) play();
  else return;
  e.preventDefault();
});
for (const name of ["dragenter", "dragover"]) {
  document.addEventListener(name, (e) => { e.preventDefault(); stage.classList.add("over"); });
}
document.addEventListener("dragleave", () => stage.classList.remove("over"));
document.addEventListener("drop", (e) => {
  e.preventDefault();
  stage.classList.remove("over");
  if (e.dataTransfer.files[0]) take(e.dataTransfer.files[0]);
  else say("drop a file: a PNG, JPEG or WebP picture", true);
});

attempt("", async () => {
  state = await (await ask("state")).json();
  by("about").textContent = state.weights.map((w) => {
    const trained = w.trained_on ? `, trained on ${w.trained_on}` : "";
    const unit = w.unit === "metres" ? `metres for a camera ${w.camera_height} m above the road` : "depth without a unit";
    return `Weights ${w.name}${trained}: pictures are seen at ${w.width}x${w.height}; ${unit}.`;
  }).join(" ");
  film();
  if (state.pictures.length) return void go(0);
  const empty = document.createElement("p");
  empty.className = "empty";
  empty.textContent = "Drop a picture of a street here, or open one.";
  stage.replaceChildren(empty);
});
