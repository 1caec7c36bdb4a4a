"use strict";
(() => {
  // HUES are those of calib.core.plot, on paper of either kind; places on the scale run from dark violet to green.
  const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const RISING = { light: [[0, "#f6fafd"], [0.5, "#98c5e1"], [1, "#2173ad"]],
    dark: [[0, "#1f2f3a"], [0.5, "#2f6f9c"], [1, "#8fd0f7"]] };
  const dark = () => {
    const asked = document.documentElement.dataset.theme;
    return asked ? asked === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  };
  const onScale = (place) => {
    const at = Math.min(Math.max(0.86 * place, 0), 1) * (SCALE.length - 1);
    const k = Math.min(Math.floor(at), SCALE.length - 2);
    return "rgb(" + SCALE[k].map((a, i) => Math.round(a + (at - k) * (SCALE[k + 1][i] - a))).join(",") + ")";
  };
  const faded = (colour, opacity) => {
    if (opacity === 1 || !colour.startsWith("#")) return colour;
    const parts = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
    return "rgba(" + parts.join(",") + "," + opacity + ")";
  };
  // Steps of 16 bits from the least value to the largest, or floats.
  const decoded = ([kind, text, least, step], row) => {
    const bytes = Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
    const raw = kind === "f4" ? new Float32Array(bytes.buffer) : new Int16Array(bytes.buffer);
    const values = kind === "f4" ? Array.from(raw, (v) => Number.isFinite(v) ? v : null)
      : Array.from(raw, (v) => v === -32768 ? null : Number((least + (v + 32767) * step).toPrecision(6)));
    if (!row) return values;
    return Array.from({ length: values.length / row }, (_, k) => values.slice(k * row, (k + 1) * row));
  };
  const told = (value, powers) => Array.isArray(value) ? value.map((one) => told(one, powers))
    : value === null ? "" : String(Number((powers ? 10 ** value : value).toPrecision(3)));
  const resolved = (value, chart, look) => {
    if (typeof value === "string" && value.startsWith("@")) {
      if (value === "@rising") return RISING[look];
      const [name, opacity] = value.slice(1).split("/");
      return faded(HUES[look][name] ?? onScale(Number(name)), Number(opacity ?? 1));
    }
    if (Array.isArray(value)) return value.map((one) => resolved(one, chart, look));
    if (value && typeof value === "object") {
      if ("$" in value) return decoded(chart.arrays[value.$], value.row);
      const whole = Object.fromEntries(Object.entries(value)
        .map(([key, one]) => [key, key === "text" && /^@(values|powers)$/.test(one) ? one : resolved(one, chart, look)]));
      if (whole.text === "@values" || whole.text === "@powers") {
        whole.text = told(whole.z ?? whole.marker.color, whole.text === "@powers");
      }
      return whole;
    }
    return value;
  };

  // Where a trace has no words of its own: both values under the names of their axes, which hold the units.
  const hover = (panel) => {
    const named = panel.y.ticktext && !panel.y.title.text;
    const lines = [panel.x.title.text && panel.x.title.text + ": %{x:.4~g}",
      !named && panel.y.title.text && panel.y.title.text + ": %{y:.4~g}"].filter(Boolean);
    return lines.join("<br>");
  };

  const NARROW_PX = 560;
  const LETTER_PX = 6.4;
  const wrapped = (text, most) => text.split(" ").reduce((lines, word) => {
    const longer = lines.length ? lines.at(-1) + " " + word : word;
    if (lines.length && longer.length > most) lines.push(word);
    else lines.splice(-1, 1, longer);
    return lines;
  }, []);
  const build = (chart, width) => {
    const look = dark() ? "dark" : "light";
    const hues = HUES[look];
    const narrow = width < NARROW_PX && chart.panels.some((panel) => panel.cell[1] - panel.cell[0] < 0.99);
    const count = chart.panels.length;
    const labels = new Set();
    const traces = [];
    const legend = chart.panels.some((panel) => panel.traces.some((trace) => trace.name));
    const named = (panel) => Math.max(0, ...(panel.y.ticktext ?? []).map((text) => text.length));
    const room = (panel) => Math.max(70, Math.min(LETTER_PX * named(panel) + 16, (width < NARROW_PX ? 0.5 : 0.42) * width));
    const left0 = narrow ? chart.panels : chart.panels.filter((panel) => panel.cell[0] < 0.001);
    const l = Math.max(...left0.map(room));
    const above = narrow ? chart.panels.slice(0, 1) : chart.panels.filter((panel) => panel.cell[2] < 0.001);
    const lines = Math.max(1, ...above.map((panel) => wrapped(panel.title,
      (narrow ? 1 : panel.cell[1] - panel.cell[0]) * (width - l - 14) / LETTER_PX).length));
    const margin = { l, r: 14, t: 36 + 14 * lines, b: legend ? 84 : 46 };
    const high = (narrow ? Math.max(chart.height, 250 * count) : chart.height) + 14 * (lines - 1) + (legend ? 64 : 24);
    const inner = { width: Math.max(width - margin.l - margin.r, 100), height: high - margin.t - margin.b };
    const layout = {
      height: high, width, margin, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, DejaVu Sans, sans-serif", size: 12, color: hues.ink }, hovermode: "closest",
      showlegend: legend, legend: { orientation: "h", yref: "container", y: 0, yanchor: "bottom", x: 0 },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: hues.silver, activecolor: hues.grey },
      shapes: [], annotations: [], barmode: "overlay", bargap: 0, dragmode: "zoom",
    };
    chart.panels.forEach((panel, k) => {
      const id = k ? String(k + 1) : "";
      const [left, right, top, bottom] = narrow ? [0, 1, k / count, (k + 1) / count] : panel.cell;
      const gap = (pixels, whole) => pixels / whole;
      const x = [left + (left > 0.001 ? gap(room(panel) + 4, inner.width) : 0), right - (right < 0.999 ? gap(12, inner.width) : 0)];
      const title = wrapped(panel.title, ((x[1] - x[0]) * inner.width) / LETTER_PX);
      const y = [1 - bottom + (bottom < 0.999 ? gap(panel.x.title.text ? 50 : 24, inner.height) : 0),
        1 - top - (top > 0.001 ? gap(10 + 14 * Math.max(title.length, 1), inner.height) : 0)];
      const common = { gridcolor: hues.grid, zeroline: false, linecolor: hues.grey, showline: !panel.bare,
        ticks: panel.bare ? "" : "outside", tickcolor: hues.grey, automargin: false, visible: !panel.bare,
        exponentformat: "none" };
      layout["xaxis" + id] = { ...common, ...resolved(panel.x, chart, look), domain: x, anchor: "y" + id,
        ...((x[1] - x[0]) * inner.width < 240 ? { nticks: 4, tickangle: 0 } : {}),
        showticklabels: panel.follows === null || panel.follows === undefined };
      layout["yaxis" + id] = { ...common, ...resolved(panel.y, chart, look), domain: y, anchor: "x" + id };
      if (panel.follows !== null) layout["xaxis" + id].matches = "x" + (panel.follows ? panel.follows + 1 : "");
      if (panel.equal) {
        Object.assign(layout["yaxis" + id], { scaleanchor: "x" + id, scaleratio: 1, constrain: "domain" });
        layout["xaxis" + id].constrain = "domain";
      }
      const own = (ref) => ref.replace(/^([xy])/, "$1" + id);
      for (const shape of resolved(panel.shapes, chart, look)) {
        layout.shapes.push({ ...shape, xref: own(shape.xref), yref: own(shape.yref) });
      }
      for (const note of resolved(panel.notes, chart, look)) {
        layout.annotations.push({ showarrow: false, ...note, font: { size: 11, ...note.font },
          xref: own(note.xref), yref: own(note.yref) });
      }
      if (panel.title) {
        layout.annotations.push({ text: title.join("<br>"), align: "left", showarrow: false, xref: "x" + id + " domain", x: 0,
          xanchor: "left", yref: "y" + id + " domain", y: 1, yanchor: "bottom", font: { size: 12 } });
      }
      for (const trace of resolved(panel.traces, chart, look)) {
        const first = Boolean(trace.name) && !labels.has(trace.name);
        labels.add(trace.name);
        const bar = trace.colorbar ?? trace.marker?.colorbar;
        if (bar) Object.assign(bar, { exponentformat: "none", x: x[1] + 0.01, xanchor: "left", y: (y[0] + y[1]) / 2, len: y[1] - y[0] });
        const under = panel.x.title.text ? panel : { ...panel, x: chart.panels[panel.follows]?.x ?? panel.x };
        const words = hover(under) && { hovertemplate: hover(under) + "<extra>" + (trace.name ?? "") + "</extra>" };
        traces.push({ ...words, ...trace, xaxis: "x" + id, yaxis: "y" + id, showlegend: first,
          ...(trace.name ? { legendgroup: trace.name } : {}) });
      }
      if (panel.traces.some((trace) => trace.showscale || trace.marker?.showscale)) {
        layout["xaxis" + id].domain = [x[0], x[1] - gap(104, inner.width)];
        for (const trace of traces) {
          const bar = trace.xaxis === "x" + id && (trace.colorbar ?? trace.marker?.colorbar);
          if (bar) bar.x = x[1] - gap(96, inner.width);
        }
      }
    });
    return [traces, layout];
  };

  const config = { displaylogo: false, plotlyServerURL: "",
    modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]] };
  const drawn = new Map();
  const draw = (place, width = Math.floor(place.clientWidth)) => {
    const look = String(dark()) + width;
    if (!width || drawn.get(place) === look) return;
    drawn.set(place, look);
    const chart = JSON.parse(place.querySelector("script").textContent);
    Plotly.react(place.querySelector(".canvas").firstChild, ...build(chart, width), config);
    // The caption tells what is drawn; ticks, and what the library measures letters with, are nothing to read.
    const drawings = [...place.querySelectorAll(".main-svg, .modebar svg"), document.getElementById("js-plotly-tester")];
    for (const one of drawings) one?.setAttribute("aria-hidden", "true");
  };
  const places = [...document.querySelectorAll(".chart")];
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
  }, { rootMargin: "400px" });
  const sizes = new ResizeObserver((entries) => {
    for (const entry of entries) if (drawn.has(entry.target)) draw(entry.target);
  });
  for (const place of places) { seen.observe(place); sizes.observe(place); }
  const again = () => { for (const place of drawn.keys()) draw(place); };
  document.getElementById("theme").addEventListener("click", again);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
  // On paper a chart has one width, whatever window it is printed from; the style shrinks it to its column.
  const printed = (place) => place.closest(".card") ? 440 : 960;
  addEventListener("beforeprint", () => { for (const place of places) if (place.clientWidth) draw(place, printed(place)); });
  addEventListener("afterprint", again);
})();
