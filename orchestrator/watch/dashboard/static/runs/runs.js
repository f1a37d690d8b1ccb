// The page of all runs.

import { showQueue } from "panolog/runs/queue.js";
/** @import { RunList, RunRow } from "../shared/messages.js" */
import { connectionLine, stream } from "panolog/shared/api.js";
import {
  addHeadings,
  bar,
  byId,
  compare,
  el,
  first,
  markSorted,
  matches,
  pill,
  reconcile,
  setBar,
  setPill,
  setText,
  toneOf,
} from "panolog/shared/dom.js";
import { ago, bytes, count, duration, fixed, percent, shellWord, short } from "panolog/shared/format.js";

/** @param {RunRow} run */
const title = (run) => (run.name === "." ? "this folder" : run.name);

/** @typedef {{key: string, label: string, sort: (run: RunRow) => string | number | null, text?: (run: RunRow) => string, number?: boolean}} Column */

/** A heading, what to sort by, and the cell's text; cells without `text` are filled in `fillRow`. @type {Column[]} */
const COLUMNS = [
  { key: "name", label: "Run", sort: title },
  { key: "status", label: "State", sort: (run) => run.label || run.status },
  { key: "stage", label: "Stage", sort: (run) => run.progress, text: (run) => run.stage_label || "–" },
  { key: "progress", label: "Progress", sort: (run) => run.progress },
  { key: "eta", label: "ETA", sort: (run) => run.eta, text: (run) => duration(lost ? null : run.eta), number: true },
  { key: "psnr", label: "PSNR", sort: (run) => run.psnr, text: (run) => fixed(run.psnr), number: true },
  {
    key: "gaussians",
    label: "Gaussians kept",
    sort: (run) => run.gaussians,
    text: (run) => short(run.gaussians),
    number: true,
  },
  { key: "size", label: "Size", sort: (run) => run.size, text: (run) => bytes(run.size), number: true },
  {
    key: "age",
    label: "Last update",
    sort: (run) => run.latest ?? run.created,
    text: (run) => ago(run.latest ?? run.created),
    number: true,
  },
];

/** @type {{runs: RunRow[] | null, folder: string, key: string, down: boolean}} */
const view = { runs: null, folder: "", key: "age", down: true };
/** Whether there is no connection: what is shown was true before. */
let lost = false;
/** The runs to compare. @type {Set<string>} */
const chosen = new Set();
const MOST = 8; // runs of a comparison
const search = byId("search", HTMLInputElement);
const sortSelect = byId("sort", HTMLSelectElement);

/** @param {string} key */
function sortBy(key) {
  view.down = view.key === key ? !view.down : key !== "name" && key !== "status";
  view.key = key;
  show();
}

/** @param {RunRow[]} runs */
function sorted(runs) {
  const { sort } = COLUMNS.find((column) => column.key === view.key) ?? COLUMNS[0];
  return runs.sort((a, b) => compare(sort(a), sort(b), view.down) || title(a).localeCompare(title(b)));
}

/** @param {RunRow} run */
function makeRow(run) {
  const link = el("a", { href: `/runs/${run.id}`, class: "run-name" });
  const cells = COLUMNS.map((column) => {
    const cell = el("td", {
      class: column.number ? "number" : null,
      "data-label": column.label,
      "data-column": column.key,
    });
    const cover = el("img", { class: "cover", alt: "", width: 112, height: 56, loading: "lazy", hidden: true });
    cover.addEventListener("error", () => {
      cover.hidden = true;
    }); // a copy of a run may lack its pictures
    const below = ["scene", "made"].map((kind) => el("span", { class: kind }));
    if (column.key === "name") cell.append(cover, el("div", {}, link, below));
    if (column.key === "status") cell.append(pill("unread"));
    if (column.key === "progress") cell.append(bar(0, "progress"), el("span", { class: "share" }));
    return cell;
  });
  const box = el("input", { type: "checkbox", on: { change: () => choose(run.id, box.checked) } });
  return el("tr", {}, el("td", { "data-column": "choose" }, box), cells);
}

/** What a run was made with, and how long it has taken. @param {RunRow} run */
function made({ width, iterations, blocks, seconds }) {
  return [
    width === null ? "" : `${count(width)} px wide`,
    iterations === null ? "" : `${count(iterations)} iterations`,
    blocks === null ? "" : blocks > 1 ? `${count(blocks)} blocks` : "1 block",
    seconds === null ? "" : duration(seconds),
  ]
    .filter(Boolean)
    .map((part) => part.replaceAll(" ", "\u00a0")) // lines end between parts
    .join("\u00a0· ");
}

/** Which runs are compared, in the order in which they were chosen. @param {string} id @param {boolean} on */
function choose(id, on) {
  chosen.delete(id);
  if (on) chosen.add(id);
  showChosen();
}

/** What can be compared now, and otherwise what it takes. */
function showChosen() {
  const button = byId("compare", HTMLAnchorElement);
  const enough = chosen.size >= 2 && chosen.size <= MOST;
  setText(
    button,
    chosen.size === 1
      ? "Compare 1 with …"
      : chosen.size > MOST
        ? `Compare at most ${MOST}`
        : chosen.size
          ? `Compare ${chosen.size}`
          : "Compare",
  );
  button.setAttribute("aria-disabled", String(!enough));
  if (enough) button.href = `/compare?${[...chosen].map((id) => `run=${id}`).join("&")}`;
  else button.removeAttribute("href");
  button.title = enough ? "" : `choose two to ${MOST} runs`;
}

/** @param {HTMLElement} row @param {RunRow} run */
function fillRow(row, run) {
  setText(first(".run-name", row), title(run));
  const box = /** @type {HTMLInputElement} */ (first("input", row));
  box.checked = chosen.has(run.id);
  box.setAttribute("aria-label", `Compare ${title(run)}`);
  const cover = /** @type {HTMLImageElement} */ (first(".cover", row));
  const picture = run.cover === null ? null : `/api/runs/${run.id}/cover/${run.cover}`;
  if (picture !== null && cover.getAttribute("src") !== picture) {
    cover.hidden = false;
    cover.src = picture;
  }
  setText(first(".made", row), made(run));
  const below = first(".scene", row);
  setText(below, run.error ?? (run.scene ? `scene ${run.scene}` : ""));
  below.classList.toggle("error", Boolean(run.error));
  const unsure = lost && run.status === "running";
  setPill(
    first(".pill", row),
    unsure ? "unknown" : toneOf(run),
    unsure ? "last state: running" : run.label || run.status,
  );
  setBar(first("progress", row), run.progress, `progress of ${title(run)}`);
  setText(first(".share", row), percent(run.progress));
  for (const { key, text } of COLUMNS) if (text) setText(first(`[data-column="${key}"]`, row), text(run));
}

function show() {
  if (view.runs === null) return;
  const found = view.runs.filter((run) =>
    matches(`${title(run)} ${run.scene ?? ""} ${run.label || run.status} ${run.stage_label}`, search.value),
  );
  reconcile(first("#runs tbody"), sorted(found), (run) => run.id, makeRow, fillRow);
  markSorted("#runs", view.key, view.down);
  sortSelect.value = view.key;
  const none = view.runs.length
    ? "No run matches the search."
    : `No run here yet. Start one with: panolog run SCENE -o ${shellWord(view.folder)}/NAME`;
  setText(byId("empty"), found.length ? "" : none);
  byId("runs").hidden = !found.length;
}

const line = connectionLine(
  (time) => {
    lost = time !== null;
    show();
  },
  () => " — below is the last known state; trying again …",
);
first("#runs thead tr").append(el("td", { "data-column": "choose" }, el("span", { class: "unseen" }, "Compare")));
addHeadings("#runs", COLUMNS, sortBy);
sortSelect.append(...COLUMNS.map(({ key, label }) => el("option", { value: key }, label)));
sortSelect.addEventListener("change", () => {
  view.key = ""; // a new choice starts in its natural direction
  sortBy(sortSelect.value);
});
search.addEventListener("input", show);
stream("", line.good, () => line.lost(), {
  /** @param {RunList} message */
  runs({ folder, runs, queue }) {
    line.good();
    showQueue(queue);
    view.runs = runs;
    for (const id of chosen) if (!runs.some((run) => run.id === id)) chosen.delete(id);
    showChosen();
    view.folder = folder;
    setText(byId("folder"), folder);
    show();
  },
});
setInterval(show, 15_000); // ages grow without messages
