"use strict";
// The page is complete without this. It marks a star or an exposure in every picture and table, sorts and filters
// tables, and blinks stars of exposures against those of the mosaic.
(() => {
  const names = JSON.parse(document.getElementById("names").textContent);
  const kinds = { s: "star", e: "exposure" };
  const tip = document.createElement("div");
  let marked = [];

  function unmark() {
    for (const each of marked) each.classList.remove("on");
    marked = [];
    tip.remove();
  }

  function keysOf(element) {
    const owner = element.closest && element.closest("[data-s], [data-e]");
    return owner && { s: owner.dataset.s, e: owner.dataset.e };
  }

  // A member that belongs to a star and to an exposure marks those of the star, of which the table and the pictures
  // of stars tell; the exposure by itself is marked from its own row, panel or point.
  function mark(keys) {
    const kind = keys.s !== undefined ? "s" : "e";
    marked = [...document.querySelectorAll(`[data-${kind}="${keys[kind]}"]`)];
    if (kind === "s" && keys.e !== undefined) {
      marked.push(...document.querySelectorAll(`tr[data-e="${keys.e}"], .panel[data-e="${keys.e}"]`));
    }
    for (const each of marked) each.classList.add("on");
    if (kind === "e") showExposure(keys.e);
    return Object.keys(kinds).filter((k) => keys[k] !== undefined)
      .map((k) => `${kinds[k]} ${names[k][keys[k]]}`).join(", ");
  }

  document.addEventListener("mouseover", (event) => {
    const keys = keysOf(event.target);
    unmark();
    if (!keys) return;
    tip.id = "tip";
    tip.textContent = mark(keys);
    document.body.append(tip);
    tip.style.left = "0px"; // as wide as it may be
    tip.style.left = `${Math.max(Math.min(event.clientX + 14, window.innerWidth - tip.offsetWidth - 4), 0)}px`;
    tip.style.top = `${Math.max(event.clientY - tip.offsetHeight - 8, 4)}px`;
  });

  // Tables

  function valueOf(row, column) {
    const text = row.cells[column].textContent.trim();
    const number = parseFloat(text);
    return Number.isNaN(number) || !/^[-+.\d]/.test(text) ? text : number;
  }

  function compare(a, b) {
    if (typeof a === "number" && typeof b === "number") return a - b;
    if (typeof a === "number") return -1;
    if (typeof b === "number") return 1;
    return a.localeCompare(b, undefined, { numeric: true });
  }

  function sortBy(table, header) {
    const down = header.getAttribute("aria-sort") === "ascending";
    for (const each of header.parentNode.cells) each.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", down ? "descending" : "ascending");
    const body = table.tBodies[0];
    const rows = [...body.rows].map((row) => [valueOf(row, header.cellIndex), row]);
    rows.sort(([a], [b]) => (down ? -compare(a, b) : compare(a, b)));
    body.append(...rows.map(([, row]) => row));
  }

  for (const table of document.querySelectorAll("table.figures")) {
    if (table.tBodies[0].rows.length < 3) continue;
    table.classList.add("sortable");
    for (const header of table.tHead.rows[0].cells) {
      header.tabIndex = 0;
      header.addEventListener("click", () => sortBy(table, header));
      header.addEventListener("keydown", (event) => { if (event.key === "Enter") sortBy(table, header); });
    }
    if (table.tBodies[0].rows.length < 8) continue;
    const filter = document.createElement("input");
    filter.type = "search";
    filter.className = "filter";
    filter.placeholder = "show rows that contain …";
    filter.setAttribute("aria-label", "show rows that contain");
    filter.addEventListener("input", () => {
      const wanted = filter.value.toLowerCase();
      for (const row of table.tBodies[0].rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
    });
    table.parentNode.before(filter);
  }

  // Stars of an exposure against those of the mosaic

  const cutouts = [...document.querySelectorAll(".cutout")];

  function showExposure(exposure) {
    for (const cutout of cutouts) {
      const wanted = cutout.querySelector(`.single[data-e="${exposure}"]`);
      if (!wanted) continue;
      for (const each of cutout.querySelectorAll(".single.shown")) each.classList.remove("shown");
      wanted.classList.add("shown");
    }
  }

  if (cutouts.length) {
    for (const cutout of cutouts) {
      cutout.classList.add("live");
      cutout.querySelector(".single").classList.add("shown");
      cutout.addEventListener("click", () => {
        const singles = [...cutout.querySelectorAll(".single")];
        const next = (singles.findIndex((each) => each.classList.contains("shown")) + 1) % singles.length;
        for (const each of singles) each.classList.toggle("shown", each === singles[next]);
      });
    }
    document.getElementById("blinking").textContent =
      " The two blink; a click, or pointing at an exposure, shows the star in another exposure.";
    if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) {
      setInterval(() => { for (const each of cutouts) each.classList.toggle("flip"); }, 800);
    }
  }

  // What the list of contents leads to is unfolded

  function unfold() {
    const target = document.getElementById(location.hash.slice(1));
    const details = target && target.closest("details");
    if (details && !details.open) { details.open = true; target.scrollIntoView(); }
  }
  window.addEventListener("hashchange", unfold);
  unfold();

  // On paper everything is shown

  const folded = () => [...document.querySelectorAll("details:not([open])")];
  let opened = [];
  window.addEventListener("beforeprint", () => { opened = folded(); for (const each of opened) each.open = true; });
  window.addEventListener("afterprint", () => { for (const each of opened) each.open = false; });
})();
