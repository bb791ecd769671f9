"use strict";
for (const wipe of document.querySelectorAll(".wipe")) {
  const slider = wipe.querySelector("input"), stack = wipe.querySelector(".stack");
  const cut = () => {
    stack.style.setProperty("--cut", slider.value + "%");
    slider.setAttribute("aria-valuetext", "photograph " + slider.value + " %, render the rest");
  };
  const drag = event => {
    if (event.type === "pointermove" && !(event.buttons & 1)) return;
    const box = stack.getBoundingClientRect();
    slider.value = 100 * (event.clientX - box.left) / box.width;
    cut();
  };
  slider.addEventListener("input", cut);
  stack.addEventListener("pointerdown", drag);
  stack.addEventListener("pointermove", drag);
  cut();
}
const power = value => (10 ** value).toPrecision(3);
for (const svg of document.querySelectorAll(".chart svg")) {
  const output = svg.parentNode.querySelector("output"), cross = svg.querySelector(".cross"), note = output.textContent;
  const lines = [...svg.querySelectorAll("path[data-values]")].filter(path => !path.classList.contains("faint")).map(path => {
    const flat = path.dataset.values.split(" ").map(Number);
    return { name: path.dataset.name, at: path.dataset.at.split(" ").map(Number), xs: flat.filter((_, i) => i % 2 === 0),
             ys: flat.filter((_, i) => i % 2 === 1), bars: path.classList.contains("bars") };
  });
  const show = event => {
    const box = svg.getBoundingClientRect(), x = (event.clientX - box.left) / box.width * svg.viewBox.baseVal.width;
    let place = null;
    const words = lines.map(line => {
      let best = 0;
      line.at.forEach((each, i) => {
        const nearer = line.bars ? each <= x && i < line.at.length - 1 : Math.abs(each - x) < Math.abs(line.at[best] - x);
        if (nearer) best = i;
      });
      if (place === null || Math.abs(line.at[best] - x) < Math.abs(place - x)) { place = line.at[best]; show.x = line.xs[best]; }
      return line.name + " " + Number(line.ys[best].toPrecision(5)).toLocaleString("en");
    });
    cross.setAttribute("x1", place); cross.setAttribute("x2", place); cross.style.visibility = "visible";
    const at = svg.dataset.powers === "1" ? power(show.x) : Number(show.x.toPrecision(6)).toLocaleString("en");
    output.textContent = svg.dataset.x + " " + at + ": " + words.join(", ");
  };
  svg.addEventListener("pointermove", show);
  svg.addEventListener("pointerdown", show);
  svg.addEventListener("pointerleave", () => { output.textContent = note; cross.style.visibility = "hidden"; });
}
