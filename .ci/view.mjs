// The steps of `.ci/view`, over the browser's debugging protocol: node .ci/view.mjs DEVTOOLS ADDRESS PICTURE OUT
import { writeFileSync } from "node:fs";

const [devtools, address, picture, out] = process.argv.slice(2);
const port = new URL(devtools).port;
const tabs = await (await fetch(`http://127.0.0.1:${port}/json`)).json();
const socket = new WebSocket(tabs.find((tab) => tab.type === "page").webSocketDebuggerUrl);
await new Promise((open) => { socket.onopen = open; });
let last = 0;
const waiting = new Map(), faults = [];
socket.onmessage = ({ data }) => {
  const { id, method, params, result, error } = JSON.parse(data);
  if (id) {
    const { resolve, reject } = waiting.get(id);
    error ? reject(new Error(error.message)) : resolve(result);
  } else if (method === "Runtime.exceptionThrown") faults.push(params.exceptionDetails.exception?.description ?? params.exceptionDetails.text);
  else if (method === "Log.entryAdded" && params.entry.level === "error") faults.push(params.entry.text + " " + (params.entry.url ?? ""));
};
const send = (method, params = {}) => new Promise((resolve, reject) => {
  waiting.set(++last, { resolve, reject });
  socket.send(JSON.stringify({ id: last, method, params }));
});
const value = async (expression) => {
  const { result, exceptionDetails } = await send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true });
  if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
  return result.value;
};
const text = (id) => value(`document.getElementById("${id}").textContent`);
const until = async (what, expression) => {
  for (let i = 0; i < 600; i++) {
    if (await value(expression)) return;
    await new Promise((done) => setTimeout(done, 50));
  }
  throw new Error(`${what}: it did not happen; the page says "${await text("message")}", "${await text("readout")}"`);
};
const box = () => value(`(() => { const b = document.querySelector("#stage canvas").getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()`);
const mouse = async (type, [x, y], more = {}) => {
  const [left, top, width, height] = await box();
  await send("Input.dispatchMouseEvent", { type, x: left + x * width, y: top + y * height, button: "left", clickCount: 1, ...more });
};
const key = async (name) => {
  for (const type of ["keyDown", "keyUp"]) await send("Input.dispatchKeyEvent", { type, key: name, code: name, windowsVirtualKeyCode: name === "Enter" ? 13 : 0, text: name === "Enter" ? "\r" : undefined });
};
const shoot = async (name) => {
  const { data } = await send("Page.captureScreenshot", { format: "png", captureBeyondViewport: true });
  writeFileSync(`${out}/view-${name}.png`, Buffer.from(data, "base64"));
};
const check = (good, what) => { if (!good) throw new Error(what); };
const choose = (which) => value(`document.querySelector("input[value=${which}]").click()`);

for (const domain of ["Page", "Runtime", "Log", "DOM"]) await send(domain + ".enable");
for (const [name, width, height, mobile, scheme] of [["desk", 1280, 900, false, "light"], ["phone", 390, 844, true, "dark"]]) {
  await send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile });
  await send("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: scheme }] });
  await send("Page.navigate", { url: address });
  await until("the first picture of the folder", `document.querySelector("#stage canvas") && document.getElementById("readout").textContent.includes(" m ")`);

  // A picture that is chosen, and depth under the pointer.
  const { root } = await send("DOM.getDocument");
  const { nodeId } = await send("DOM.querySelector", { nodeId: root.nodeId, selector: "#file" });
  await send("DOM.setFileInputFiles", { nodeId, files: [picture] });
  const file = picture.split("/").pop();
  await until("a picture that is chosen", `document.getElementById("name").textContent === ${JSON.stringify(file)}`);
  await mouse("mouseMoved", [0.5, 0.95], { button: "none" });
  const near = await text("readout");
  await mouse("mouseMoved", [0.5, 0.55], { button: "none" });
  const far = await text("readout");
  const metres = (said) => Number(said.match(/: ([0-9.]+) m/)[1]);
  check(metres(far) > metres(near), `the road is nearer below: "${near}", "${far}"`);
  await shoot(`${name}-depth`);

  // The keyboard moves the cross, and Enter asks for attention.
  await value(`document.querySelector("#stage canvas").focus()`);
  await key("ArrowRight");
  check((await text("readout")) !== far, "an arrow key moves the cross");
  await key("Enter");
  await until("attention", `document.querySelectorAll("#layer option").length > 0 && document.getElementById("message").textContent === ""`);
  await shoot(`${name}-attention`);
  await mouse("mousePressed", [0.3, 0.6]);
  await mouse("mouseReleased", [0.3, 0.6]);
  await until("attention of a click", `document.getElementById("message").textContent === ""`);

  // Points, turned with the mouse: pixels move.
  await choose("points");
  const pixels = () => value(`document.querySelector("#stage canvas").toDataURL().length + ":" + document.querySelector("#stage canvas").toDataURL().slice(-4000)`);
  check((await text("message")) === "", `points: ${await text("message")}`);
  const before = await pixels();
  await mouse("mousePressed", [0.5, 0.5]);
  await mouse("mouseMoved", [0.42, 0.45], { buttons: 1 });
  await mouse("mouseReleased", [0.42, 0.45]);
  check((await pixels()) !== before, "the points turn with the mouse");
  await shoot(`${name}-points`);

  // A film: the next picture, and a file that is no picture.
  await choose("depth");
  await value(`document.getElementById("next").click()`);
  await until("the next picture", `document.getElementById("count").textContent.startsWith("2 of")`);
  await until("its map", `document.getElementById("message").textContent === ""`);
  await shoot(`${name}-film`);
  await send("DOM.setFileInputFiles", { nodeId, files: [process.argv[1]] });
  await until("a word on a file that is none", `document.getElementById("message").textContent.includes("PNG, JPEG or WebP")`);
  const expected = faults.splice(0).filter((fault) => !fault.includes("400"));
  check(expected.length === 0, `errors on the console: ${expected.join("; ")}`);
  // Everything can be reached, and nothing is wider than the screen.
  check((await value("document.documentElement.scrollWidth")) <= width, "the page is wider than the screen");
  const nameless = await value(`[...document.querySelectorAll("input,select,button,canvas[tabindex]")].filter((e) => !(e.labels?.length || e.getAttribute("aria-label") || e.textContent.trim())).length`);
  check(nameless === 0, `${nameless} controls have no name`);
  // Contrast of text with what is behind it (WCAG 2, 1.4.3).
  const poor = await value(`(() => {
    const light = (c) => c.match(/[0-9.]+/g).slice(0, 3).map((x) => x / 255).map((x) => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4).reduce((s, x, i) => s + x * [0.2126, 0.7152, 0.0722][i], 0);
    const behind = (e) => { for (; e; e = e.parentElement) { const c = getComputedStyle(e).backgroundColor; if (!c.includes(", 0)") && c !== "transparent") return c; } return "rgb(255, 255, 255)"; };
    return [...document.querySelectorAll("main *")].filter((e) => [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim())).filter((e) => { const [a, b] = [light(getComputedStyle(e).color), light(behind(e))]; return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) < 4.5; }).map((e) => e.tagName + ": " + e.textContent.trim().slice(0, 30));
  })()`);
  check(poor.length === 0, `too little contrast: ${poor.join("; ")}`);
  console.log(`${name}: all steps done, no error on the console`);
}
socket.close();
