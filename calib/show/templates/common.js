"use strict";
(() => {
  const get = (id) => document.getElementById(id);
  const speak = (words) => { get("spoken").textContent = words; };

  // Theme: the system's, until somebody asks for the other one.
  const theme = get("theme");
  theme.hidden = false;
  theme.addEventListener("click", () => {
    const root = document.documentElement;
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    speak(root.dataset.theme + " colours");
  });

  // Tables: a click on a heading sorts by it, a second one the other way round. Blanks come last.
  const order = (row, column) => {
    const cell = row.cells[column];
    if (cell.dataset.value !== undefined) return cell.dataset.value === "" ? null : Number(cell.dataset.value);
    const text = cell.textContent.trim();
    if (text === "" || text === "–") return null;
    return cell.className === "number" ? Number.parseFloat(text) : text;
  };
  const compare = (a, b) => typeof a === "number" && typeof b === "number"
    ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...table.tBodies[0].rows].map((row) => [order(row, column), row]);
      rows.sort(([a], [b]) => a === null || b === null
        ? (a === null) - (b === null) : (down ? -1 : 1) * compare(a, b));
      table.tBodies[0].append(...rows.map(([, row]) => row));
      speak("sorted by " + head.textContent.trim() + (down ? ", descending" : ", ascending"));
    }));
  }

  // What can be filtered is shown where it has all the words that were typed.
  const filter = get("filter");
  if (filter) {
    const parts = [...document.querySelectorAll(".filtered")];
    get("filter-line").hidden = parts.length === 0;
    filter.addEventListener("input", () => {
      const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
      let left = 0;
      for (const part of parts) {
        const text = part.textContent.toLowerCase();
        part.hidden = !words.every((word) => text.includes(word));
        left += part.hidden ? 0 : 1;
      }
      get("filter-count").textContent = words.length ? left + " of " + parts.length : "";
    });
  }
})();
