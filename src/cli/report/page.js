for (const film of document.querySelectorAll(".film")) {
  const frames = [...film.querySelectorAll(".frames")];
  const slider = film.querySelector("input"), output = film.querySelector("output");
  const show = () => {
    frames.forEach((frame, i) => { frame.hidden = i !== Number(slider.value); });
    output.textContent = "step " + frames[Number(slider.value)].dataset.step;
    slider.setAttribute("aria-valuetext", output.textContent);
  };
  slider.addEventListener("input", show);
  show();
}
