// The page of all runs.

import { stream } from "./api.js";
import { connectionLine } from "./connection.js";
import { bar, byId, el, pill, reconcile, setPill, setText } from "./dom.js";
import { ago, bytes, duration, fixed, percent, short } from "./format.js";

const base = (path) => (path ?? "").split("/").filter(Boolean).pop() ?? "–";
const title = (run) => (run.name === "." ? "this folder" : run.name);

// Columns: a heading, what to sort by, and the cell's text. Those without `text` have cells of their own.
const COLUMNS = [
  { key: "name", label: "Run", sort: title },
  { key: "status", label: "State", sort: (run) => run.status },
  { key: "stage", label: "Stage", sort: (run) => run.progress, text: (run) => run.stage_label || "–" },
  { key: "progress", label: "Progress", sort: (run) => run.progress },
  { key: "eta", label: "ETA", sort: (run) => run.eta, text: (run) => duration(run.eta), number: true },
  { key: "psnr", label: "PSNR", sort: (run) => run.psnr, text: (run) => fixed(run.psnr), number: true },
  { key: "gaussians", label: "Gaussians", sort: (run) => run.gaussians, text: (run) => short(run.gaussians), number: true },
  { key: "size", label: "Size", sort: (run) => run.size, text: (run) => bytes(run.size), number: true },
  { key: "age", label: "Latest", sort: (run) => run.latest ?? run.created, text: (run) => ago(run.latest ?? run.created), number: true },
];

const view = { runs: null, key: "age", down: true, search: "" };

function heads() {
  const row = document.querySelector("#runs thead tr");
  for (const column of COLUMNS) {
    const button = el("button", { type: "button", class: "sorter", on: { click: () => sortBy(column.key) } }, column.label);
    row.append(el("th", { scope: "col", class: column.number ? "number" : null, "data-column": column.key }, button));
    byId("sort").append(el("option", { value: column.key }, column.label));
  }
  byId("sort").addEventListener("change", (event) => {
    view.key = null; // a new choice begins with its natural direction
    sortBy(event.target.value);
  });
}

function sortBy(key) {
  view.down = view.key === key ? !view.down : key !== "name" && key !== "status";
  view.key = key;
  show();
}

function sorted(runs) {
  const { sort } = COLUMNS.find((column) => column.key === view.key);
  const sign = view.down ? -1 : 1;
  return [...runs].sort((a, b) => {
    const [x, y] = [sort(a), sort(b)];
    if (x === y) return title(a).localeCompare(title(b));
    if (x === null || x === undefined) return 1; // what is not known comes last either way
    if (y === null || y === undefined) return -1;
    return sign * (typeof x === "string" ? x.localeCompare(y) : x - y);
  });
}

function makeRow(run) {
  const link = el("a", { href: `/runs/${run.id}`, class: "run-name" });
  const cells = COLUMNS.map((column) => {
    const cell = el("td", { class: column.number ? "number" : null, "data-label": column.label, "data-column": column.key });
    if (column.key === "name") cell.append(link, el("span", { class: "scene" }));
    if (column.key === "status") cell.append(pill(run.status));
    if (column.key === "progress") cell.append(bar(0, "progress"), el("span", { class: "share" }));
    return cell;
  });
  return el("tr", {}, cells);
}

function fillRow(row, run) {
  const cell = (key) => row.querySelector(`[data-column="${key}"]`);
  setText(row.querySelector(".run-name"), title(run));
  const below = row.querySelector(".scene");
  setText(below, run.error ?? (run.scene ? `scene ${base(run.scene)}` : ""));
  below.classList.toggle("error", Boolean(run.error));
  setPill(row.querySelector(".pill"), run.error ? "unreadable" : run.status);
  const progress = row.querySelector("progress");
  progress.value = run.progress ?? 0;
  progress.setAttribute("aria-label", `progress of ${title(run)}`);
  setText(row.querySelector(".share"), percent(run.progress));
  for (const column of COLUMNS) if (column.text) setText(cell(column.key), column.text(run));
}

function show() {
  if (view.runs === null) return;
  const words = view.search.toLowerCase().split(/\s+/).filter(Boolean);
  const found = view.runs.filter((run) => {
    const text = `${title(run)} ${run.scene ?? ""} ${run.status} ${run.stage_label ?? ""}`.toLowerCase();
    return words.every((word) => text.includes(word));
  });
  reconcile(document.querySelector("#runs tbody"), sorted(found), (run) => run.id, makeRow, fillRow);
  for (const head of document.querySelectorAll("#runs th")) {
    const sort = head.dataset.column === view.key ? (view.down ? "descending" : "ascending") : "none";
    head.setAttribute("aria-sort", sort);
  }
  byId("sort").value = view.key;
  const none = view.runs.length ? "No run matches the search." : "No run here yet. Start one with: panolog run SCENE -o RUN";
  setText(byId("empty"), found.length ? "" : none);
  byId("runs").hidden = !found.length;
}

const line = connectionLine();
heads();
byId("search").addEventListener("input", (event) => {
  view.search = event.target.value;
  show();
});
stream("", {
  open: line.good,
  lost: () => line.lost(),
  runs: ({ folder, runs }) => {
    line.good();
    view.runs = runs;
    setText(byId("folder"), folder);
    show();
  },
});
setInterval(show, 15_000); // ages grow although nothing happens
