// What the page does on a click. Without this script it shows the same figures and pictures.
"use strict";

/** A new element with `properties`, and `children` in it. */
function make(name, properties = {}, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

document.querySelectorAll(".hint").forEach((hint) => { hint.hidden = false; });

// Tables: sorted by a column, filtered by a text.

/** The number that a cell begins with, or its text; null for an empty cell or one without a figure. */
function valueOf(cell) {
  const text = cell.textContent.trim().replace(/^×/, "");
  if (["", "–", "n/a"].includes(text.split(" (")[0])) return null;
  const number = /^[-+]?[\d,]*\.?\d+(e[-+]?\d+)?(?![\w/])/i.exec(text);
  return number ? Number(number[0].replaceAll(",", "")) : text;
}

const alphabet = new Intl.Collator("en", { numeric: true });

/** Numbers before texts; `sign` is -1 for the largest first. What is missing comes last. */
function compare(a, b, sign) {
  if (a === null || b === null) return (a === null) - (b === null);
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
  return sign * (typeof a === "number" ? a - b : alphabet.compare(a, b));
}

function makeSortable(table) {
  const body = table.tBodies[0];
  const original = [...body.rows];
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    if (!head.textContent.trim()) return;
    const first = head.textContent.endsWith("↑") ? "descending" : "ascending"; // the best above
    const second = first === "ascending" ? "descending" : "ascending";
    const button = make("button", { type: "button" }, ...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const next = { [first]: second, [second]: null }[head.ariaSort];
      const order = next === undefined ? first : next; // best, worst, as it was
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      let rows = original;
      if (order) {
        head.setAttribute("aria-sort", order);
        const sign = order === "ascending" ? 1 : -1;
        const values = new Map(original.map((row) => [row, valueOf(row.cells[column])]));
        rows = original.toSorted((a, b) => compare(values.get(a), values.get(b), sign));
      }
      body.replaceChildren(...rows);
    });
  });
}

function makeFilterable(table) {
  const rows = [...table.tBodies[0].rows];
  const box = make("input", { type: "search", placeholder: "filter the rows" });
  box.ariaLabel = "filter the rows of the table below";
  box.addEventListener("input", () => {
    const words = box.value.toLowerCase().split(/\s+/);
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
    }
  });
  table.parentElement.before(box);
}

for (const table of document.querySelectorAll(".table table")) {
  const rows = [...(table.tBodies[0]?.rows ?? [])];
  const named = table.tHead.textContent.trim();
  if (rows.length > 1 && named) makeSortable(table);
  const ofOneRun = rows[0]?.dataset.runs && new Set(rows.map((row) => row.dataset.runs)).size === 1;
  if (rows.length > 4 && named && !ofOneRun) makeFilterable(table);
}

// Where a figure comes from: a panel below, for a row of a table and a mark of a plot.

const panel = document.getElementById("origin");
const closer = panel.querySelector(".close");
let opener = null;

function closePanel() {
  panel.hidden = true;
  document.documentElement.classList.remove("explaining");
  document.querySelectorAll(".shown").forEach((element) => element.classList.remove("shown"));
}

/** Show `title`, and the runs behind `element`. */
function showOrigin(element, title) {
  closePanel();
  opener = element;
  element.classList.add("shown");
  const runs = element.dataset.runs.split(" ").map((key) => document.getElementById(`run-${key}`));
  const copies = runs.filter(Boolean).map((run) => {
    const copy = run.parentElement.cloneNode(true);
    copy.open = runs.length === 1;
    copy.querySelectorAll("[id]").forEach((inner) => inner.removeAttribute("id"));
    return copy;
  });
  panel.querySelector("h2").textContent = title;
  panel.querySelector(".runs").replaceChildren(...copies);
  panel.hidden = false;
  document.documentElement.classList.add("explaining"); // there is room to scroll above the panel
  panel.scrollTop = 0;
}

/** A row in words: every figure with the head of its column. */
function rowInWords(row) {
  const heads = [...row.closest("table").tHead.rows[0].cells];
  const texts = [...row.cells].map((cell) => cell.textContent.trim());
  const figures = texts.slice(1).map((text, n) => `${heads[n + 1].innerText} ${text}`);
  return `${texts[0]}: ${figures.join("; ")}`.replace(/ [↑↓]/g, "");
}

document.addEventListener("click", (event) => {
  const row = event.target.closest("tr[data-runs]");
  if (!row || String(getSelection())) return; // the click ends the selection of a text
  event.preventDefault(); // of the link to the run
  showOrigin(row, rowInWords(row));
  closer.focus();
});
for (const mark of document.querySelectorAll(".mark")) {
  const show = () => showOrigin(mark, mark.getAttribute("aria-label"));
  mark.addEventListener("focus", show);
  mark.addEventListener("click", show);
  mark.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      closer.focus();
    }
  });
}
/** Go back to where the panel was opened. */
function leavePanel() {
  (opener.querySelector("a.origin") ?? opener).focus();
  closePanel();
}
closer.addEventListener("click", leavePanel);
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && !panel.hidden) leavePanel();
});

// Frames: two pictures under a divider, an enlarged detail, error maps.

function makeComparison(frame) {
  const figures = [...frame.querySelectorAll("figure")];
  const [x, y, width, height] = frame.dataset.box.split(" ").map(Number);
  const zoom = Number(frame.dataset.zoom);
  const original = figures[0].querySelector("img");

  const choose = (label, chosen) => {
    const names = figures.map((figure) => figure.querySelector("span").textContent);
    const select = make("select", {}, ...names.map((name) => make("option", {}, name)));
    select.selectedIndex = chosen;
    select.addEventListener("change", update);
    return [select, make("label", {}, `${label} `, select)];
  };
  const press = (label, action) => {
    const button = make("button", { type: "button" }, label);
    button.ariaPressed = "false";
    button.addEventListener("click", () => {
      button.ariaPressed = String(button.ariaPressed !== "true");
      action();
    });
    return button;
  };
  const two = figures.length > 2; // one rendering is shown beside the ground truth
  const [left, leftLabel] = choose("left", two ? 1 : 0);
  const [right, rightLabel] = choose("right", two ? 2 : 1);
  const errors = press("error maps", update);
  const zoomed = press(`enlarge ${zoom} times`, () => enlarge(x + width / 2, y + height / 2));
  zoomed.title = `where ${frame.dataset.where}`;

  const images = [make("img"), make("img")];
  const detail = make("div", { className: "detail" });
  detail.style.cssText =
    `left: ${100 * x}%; top: ${100 * y}%; width: ${100 * width}%; height: ${100 * height}%`;
  const stage = make("div", { className: "stage" },
    make("div", { className: "layer" }, images[1]),
    make("div", { className: "layer left" }, images[0]),
    detail, make("div", { className: "divider" }));
  const [wide, high] = ["width", "height"].map((name) => original.getAttribute(name));
  stage.style.aspectRatio = `${wide} / ${high}`;
  stage.style.setProperty("--zoom", zoom);
  stage.title = "Drag to move the line between the pictures, click to enlarge";
  const names = make("div", { className: "names" }, make("span"), make("span"));
  const slider = make("input", { type: "range", min: 0, max: 100, step: 0.5, value: 50 });
  slider.ariaLabel = "where the left picture ends";
  slider.addEventListener("input", divide);

  function update() {
    [left, right].forEach((select, side) => {
      const figure = figures[select.selectedIndex];
      const wanted = errors.ariaPressed === "true" && figure.querySelector(".error");
      const shown = wanted || figure.querySelector(".rendering");
      images[side].src = shown.src;
      images[side].alt = shown.alt;
      const titles = [...figure.querySelectorAll("span")].map((span) => span.textContent);
      names.children[side].textContent = [...titles, ...(wanted ? ["error map"] : [])].join(", ");
    });
  }
  function divide() {
    stage.style.setProperty("--split", `${slider.value}%`);
  }
  /** Enlarge what is around a place, in shares of the picture, or show the whole again. */
  function enlarge(across, down) {
    const origin = (centre) => Math.min(1, Math.max(0, (centre * zoom - 0.5) / (zoom - 1)));
    stage.style.setProperty("--x", `${100 * origin(across)}%`);
    stage.style.setProperty("--y", `${100 * origin(down)}%`);
    zoomed.ariaPressed = String(stage.classList.toggle("zoomed"));
  }

  let begun = null; // where the pointer went down, while it has not moved
  stage.addEventListener("pointerdown", (event) => {
    begun = event.clientX;
    stage.setPointerCapture(event.pointerId);
  });
  stage.addEventListener("pointermove", (event) => {
    if (!event.buttons || (begun !== null && Math.abs(event.clientX - begun) < 4)) return;
    begun = null;
    const place = stage.getBoundingClientRect();
    slider.value = (100 * (event.clientX - place.left)) / place.width;
    divide();
  });
  stage.addEventListener("click", (event) => {
    if (begun === null) return; // the divider was dragged
    const place = stage.getBoundingClientRect();
    enlarge((event.clientX - place.left) / place.width, (event.clientY - place.top) / place.height);
  });

  const controls = make("div", { className: "controls" }, leftLabel, rightLabel, zoomed, errors);
  const comparison = make("div", { className: "comparison" }, controls, names, stage, slider);
  comparison.style.maxWidth = `${Math.max(wide, 560)}px`;
  frame.prepend(comparison);
  frame.classList.add("live");
  update();
  divide();
}
document.querySelectorAll(".frame").forEach(makeComparison);
