"use strict";

// Rows, points and lines carry data-method, data-solver or both; a filter hides those whose box is not ticked. The choice
// is kept in the address, so that a filtered page can be linked to.
const boxes = [...document.querySelectorAll(".filters input")];

function applyFilters() {
  const hidden = { method: new Set(), solver: new Set() };
  for (const box of boxes) if (!box.checked) hidden[box.name].add(box.value);
  let shown = 0;
  for (const item of document.querySelectorAll("[data-method], [data-solver]")) {
    const off = hidden.method.has(item.dataset.method) || hidden.solver.has(item.dataset.solver);
    if (item instanceof SVGElement) item.classList.toggle("off", off);
    else item.hidden = off;
    if (item.matches("tr.result") && !off) shown += 1;
  }
  document.getElementById("shown").textContent = `${shown} result(s) shown`;
}

function filtersToAddress() {
  const query = new URLSearchParams();
  for (const box of boxes) if (!box.checked) query.append(`no-${box.name}`, box.value);
  history.replaceState(null, "", query.toString() ? `#${query}` : location.pathname + location.search);
}

function filtersFromAddress() {
  if (document.getElementById(location.hash.slice(1))) return applyFilters(); // a link to a section
  const query = new URLSearchParams(location.hash.slice(1));
  for (const box of boxes) box.checked = !query.getAll(`no-${box.name}`).includes(box.value);
  applyFilters();
}

for (const box of boxes) box.addEventListener("change", () => { applyFilters(); filtersToAddress(); });
for (const button of document.querySelectorAll(".filters .all, .filters .none")) {
  button.addEventListener("click", () => {
    const on = button.classList.contains("all");
    for (const box of button.parentElement.querySelectorAll("input")) box.checked = on;
    applyFilters();
    filtersToAddress();
  });
}
addEventListener("hashchange", filtersFromAddress);
filtersFromAddress();

// Cells with data-value sort by it as numbers, missing values last; others sort as text.
function sortTable(head) {
  const body = head.closest("table").tBodies[0];
  const column = head.cellIndex;
  const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  const value = (row) => {
    const cell = row.cells[column];
    if (!("value" in cell.dataset)) return cell.textContent;
    return cell.dataset.value === "" ? null : Number(cell.dataset.value);
  };
  const order = (a, b) => {
    const x = value(a), y = value(b);
    if (x === null || y === null) return (x === null) - (y === null);
    return sign * (typeof x === "number" ? x - y : x.localeCompare(y));
  };
  body.append(...[...body.rows].sort(order));
  for (const other of head.parentElement.cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", sign === 1 ? "ascending" : "descending");
}

for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => sortTable(button.closest("th")));
}

for (const button of document.querySelectorAll("button.copy")) {
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(button.nextElementSibling.textContent);
    button.textContent = "copied";
  });
}

// What a point stands for, beside the pointer or, in a picture that has the focus, by the arrow keys.
const card = document.createElement("div");
card.className = "card";
card.hidden = true;
card.setAttribute("role", "status");
document.body.append(card);

function showPoint(point) {
  document.querySelector(".point.chosen")?.classList.remove("chosen");
  card.hidden = !point;
  if (!point) return;
  point.classList.add("chosen");
  card.textContent = point.querySelector("title").textContent;
  const place = point.getBoundingClientRect();
  const left = Math.min(place.right + 8, innerWidth - card.offsetWidth - 8);
  card.style.left = `${left + scrollX}px`;
  card.style.top = `${place.bottom + 8 + scrollY}px`;
}

for (const figure of document.querySelectorAll("figure")) {
  if (!figure.querySelector(".point")) continue;
  figure.tabIndex = 0;
  figure.addEventListener("pointerover", (event) => showPoint(event.target.closest(".point")));
  figure.addEventListener("pointerleave", () => showPoint(null));
  figure.addEventListener("blur", () => showPoint(null));
  figure.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (event.key === "Escape") showPoint(null);
    if (!step) return;
    event.preventDefault();
    const points = [...figure.querySelectorAll(".point")].filter((point) => !point.closest(".off"));
    const at = points.findIndex((point) => point.classList.contains("chosen"));
    const next = at < 0 ? (step > 0 ? 0 : -1) : (at + step + points.length) % points.length;
    showPoint(points.at(next));
  });
}
