// Checks of a page that need a browser to be driven: accessibility by axe-core at both widths, light and dark; sliders,
// details and scrolled charts by the keyboard alone; no motion where none is wanted; nothing on the console, nothing asked
// of a network. Called by .ci/page, which installs axe-core and puppeteer-core: node page.mjs BROWSER MODULES PAGE...
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const [browserPath, modules, ...pages] = process.argv.slice(2);
const require = createRequire(pathToFileURL(modules + "/any.js"));
const puppeteer = require("puppeteer-core");
const axe = require.resolve("axe-core/axe.min.js");

const browser = await puppeteer.launch({
  executablePath: browserPath,
  args: ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"],
});
let failures = 0;
const fail = (page, words) => {
  failures += 1;
  console.error(`${page}: ${words}`);
};

for (const path of pages) {
  const page = await browser.newPage();
  const address = pathToFileURL(path).href;
  page.on("console", (message) => fail(path, `console: ${message.text()}`));
  page.on("pageerror", (error) => fail(path, `error: ${error}`));
  page.on("request", (request) => {
    if (!request.url().startsWith("data:") && request.url() !== address) fail(path, `asks for ${request.url()}`);
  });
  for (const [width, height] of [[390, 844], [1280, 900]]) {
    await page.setViewport({ width, height });
    for (const scheme of ["light", "dark"]) {
      await page.emulateMediaFeatures([
        { name: "prefers-color-scheme", value: scheme },
        { name: "prefers-reduced-motion", value: "reduce" },
      ]);
      await page.goto(address);
      await page.addScriptTag({ path: axe });
      const found = await page.evaluate(async () => {
        // Everything is looked at, what is folded too.
        document.querySelectorAll("details").forEach((part) => { part.open = true; });
        return (await window.axe.run(document)).violations.map((v) => ({
          id: v.id,
          help: v.help,
          where: v.nodes.slice(0, 3).map((n) => n.target.join(" ") + ": " + n.failureSummary),
        }));
      });
      for (const { id, help, where } of found) fail(path, `${width}, ${scheme}: ${id}: ${help}\n  ${where.join("\n  ")}`);
      const [wide, moving] = await page.evaluate(() => [
        document.documentElement.scrollWidth - window.innerWidth,
        document.getAnimations().length,
      ]);
      if (wide > 0) fail(path, `${width}: the page is ${wide} pixels wider than the window`);
      if (moving > 0) fail(path, `${moving} animations run though none are wanted`);
    }
  }
  // The keyboard alone: Tab reaches every control, arrows move sliders, Enter opens details.
  await page.evaluate(() => sessionStorage.clear());
  await page.goto(address);
  const controls = await page.$$eval("input, summary, [tabindex='0']", (all) => all.length);
  const reached = new Set();
  for (let i = 0; i <= controls + 1; i++) {
    await page.keyboard.press("Tab");
    const at = await page.evaluate(() => {
      const all = [...document.querySelectorAll("input, summary, [tabindex='0']")];
      const element = document.activeElement;
      const outline = getComputedStyle(element).outlineStyle;
      return { index: all.indexOf(element), type: element.type ?? element.localName, outline };
    });
    if (at.index < 0 || reached.has(at.index)) continue;
    reached.add(at.index);
    if (at.outline === "none") fail(path, `control ${at.index} (${at.type}) does not show that it has the focus`);
    if (at.type === "range") {
      const read = () => page.$eval(".film output", (output) => output.textContent);
      const steps = await page.$$eval(".film .frames", (all) => all.length);
      const before = await read();
      await page.keyboard.press("ArrowLeft");
      if (steps > 1 && (await read()) === before) fail(path, "an arrow key does not move the slider");
      await page.keyboard.press("ArrowRight");
      if ((await read()) !== before) fail(path, "the slider does not come back");
    }
    if (at.type === "summary") {
      await page.keyboard.press("Enter");
      if (!(await page.evaluate(() => document.activeElement.parentElement.open))) fail(path, "Enter opens no details");
    }
  }
  if (reached.size < controls) fail(path, `Tab reaches ${reached.size} of ${controls} controls`);
  console.log(`${path}: ${controls} controls by keyboard, axe-core at two widths in light and dark`);
  await page.close();
}
await browser.close();
process.exit(failures === 0 ? 0 : 1);
