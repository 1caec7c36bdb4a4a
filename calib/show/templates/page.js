"use strict";
(() => {
  const get = (id) => document.getElementById(id);

  // Dialogs: Escape, the button and a click beside them close them.
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.querySelector(".close").addEventListener("click", () => dialog.close());
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  }

  // Views: the picture with its residuals, drawn longer than they are.
  const views = JSON.parse(get("views-data").textContent);
  const dialog = get("view-dialog");
  const gain = get("gain");
  let current = 0;
  const factor = () => Number((10 ** (Number(gain.value) / 25)).toPrecision(2));
  const element = (name, attributes) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };
  const length = ([x, y]) => Math.hypot(x, y);
  const draw = () => {
    const view = views[current];
    const times = factor();
    const thick = view.width / 320;
    get("gain-told").textContent = String(times);
    // Pixel (0, 0) is the centre of the first one, half a pixel inside of the picture's corner.
    const svg = element("svg", { viewBox: [-0.5, -0.5, view.width, view.height].join(" "), role: "img",
      "aria-label": "Residuals of " + view.name });
    svg.append(element("image", { href: view.image, x: -0.5, y: -0.5, width: view.width, height: view.height }));
    view.points.forEach(([u, v], k) => {
      const [x, y] = view.residuals[k];
      const end = { x1: u, y1: v, x2: u + times * x, y2: v + times * y };
      svg.append(element("line", { ...end, stroke: "#000", "stroke-width": 2.2 * thick, "stroke-linecap": "round" }));
      svg.append(element("line", { ...end, stroke: "#ffb000", "stroke-width": 1.1 * thick, "stroke-linecap": "round" }));
      const mark = element("circle", { cx: u, cy: v, r: 1.3 * thick, fill: "#56b4e9", stroke: "#000", "stroke-width": 0.4 * thick });
      const title = element("title", {});
      title.textContent = "(" + u.toFixed(1) + ", " + v.toFixed(1) + "): " + length(view.residuals[k]).toFixed(4) + " px";
      mark.append(title);
      svg.append(mark);
    });
    get("view-picture").replaceChildren(svg);
  };
  const show = (which) => {
    current = (which + views.length) % views.length;
    const view = views[current];
    const sizes = view.residuals.map(length);
    const worst = Math.max(...sizes);
    get("view-title").textContent = view.name;
    get("view-told").textContent = view.points.length + " corners, RMS " + (view.rms_px ?? NaN).toFixed(4) +
      " px, the worst " + worst.toFixed(4) + " px. Blue: corner as found. Orange: to where the camera model puts it.";
    draw();
  };
  for (const button of document.querySelectorAll("button.view")) {
    button.addEventListener("click", () => {
      const view = views[Number(button.dataset.view)];
      const typical = view.residuals.map(length).sort((a, b) => a - b)[view.residuals.length >> 1] || 1;
      gain.value = String(Math.round(25 * Math.log10(Math.max(1, view.width / 25 / typical))));
      show(Number(button.dataset.view));
      dialog.showModal();
    });
  }
  gain.addEventListener("input", draw);
  get("view-before").addEventListener("click", () => show(current - 1));
  get("view-after").addEventListener("click", () => show(current + 1));
  dialog.addEventListener("keydown", (event) => {
    if (event.target === gain) return;
    if (event.key === "ArrowLeft") show(current - 1);
    if (event.key === "ArrowRight") show(current + 1);
  });
})();
