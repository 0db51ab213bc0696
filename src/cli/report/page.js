// What a reader has set outlives loading the page again; a browser that keeps nothing for pages from a file goes without.
const kept = {
  get: (name) => { try { return sessionStorage.getItem(name); } catch { return null; } },
  set: (name, value) => { try { sessionStorage.setItem(name, value); } catch { /* nothing is kept */ } },
};
document.querySelectorAll(".film").forEach((film, i) => {
  const frames = [...film.querySelectorAll(".frames")];
  const slider = film.querySelector("input"), output = film.querySelector("output");
  const show = () => {
    frames.forEach((frame, i) => { frame.hidden = i !== Number(slider.value); });
    output.textContent = "step " + frames[Number(slider.value)].dataset.step;
    slider.setAttribute("aria-valuetext", output.textContent);
  };
  const before = frames.findIndex((frame) => frame.dataset.step === kept.get("film" + i));
  if (before >= 0) slider.value = before;
  slider.addEventListener("input", () => {
    show();
    kept.set("film" + i, slider.value === slider.max ? "" : frames[Number(slider.value)].dataset.step);
  });
  show();
});
document.querySelectorAll("details").forEach((part) => {
  if (kept.get(part.id)) part.open = true;
  part.addEventListener("toggle", () => kept.set(part.id, part.open ? "open" : ""));
});
const again = document.getElementById("again");
if (again) {
  again.checked = kept.get("again") !== "off";
  again.addEventListener("change", () => kept.set("again", again.checked ? "on" : "off"));
  // Not while the page is being used.
  const used = () => document.hidden || ![null, document.body, again].includes(document.activeElement);
  setInterval(() => { if (again.checked && !used()) location.reload(); }, 1000 * again.dataset.seconds);
}
