// The table of Stage I and all blocks. Only the rows in sight are in the page, so a thousand cost no more than thirty.

import { byId, el, setPill, setText, pill } from "./dom.js";
import { bytes, count, duration, fixed, short, significant, taskLabel } from "./format.js";

const ROW = 44; // pixels, as in run.css
const SPARE = 8; // rows beyond each edge
const MANY = 12; // rows from which on the table scrolls by itself

const share = (row) => (row.kept || row.status === "done" ? 1 : row.iterations ? (row.iteration ?? 0) / row.iterations : 0);
const last = (row) => row.reasons?.[row.reasons.length - 1] ?? "";
const COLUMNS = [
  { key: "block", label: "Block", value: (row) => row.block },
  { key: "status", label: "State", value: (row) => row.status },
  { key: "iteration", label: "Iteration", value: share, number: true },
  { key: "rate", label: "it/s", value: (row) => (row.status === "running" ? row.rate : null), text: (row) => (row.status === "running" ? fixed(row.rate, 1) : "–"), number: true },
  { key: "eta", label: "ETA", value: (row) => row.eta, text: (row) => duration(row.eta), number: true },
  { key: "loss", label: "Loss", value: (row) => row.loss, text: (row) => significant(row.loss), number: true },
  { key: "psnr", label: "PSNR", value: (row) => row.psnr, text: (row) => fixed(row.psnr), number: true },
  { key: "gaussians", label: "Gaussians", value: (row) => row.gaussians ?? row.plan?.gaussians, text: (row) => short(row.gaussians ?? row.plan?.gaussians), number: true },
  { key: "memory", label: "Memory", value: (row) => row.memory, text: (row) => bytes(row.memory), number: true },
  { key: "node", label: "Node", value: (row) => row.node, text: (row) => row.node ?? "–" },
  { key: "device", label: "Device", value: (row) => row.device, text: (row) => row.device || "–" },
  { key: "retries", label: "Retries", value: (row) => row.retries, text: (row) => count(row.retries), number: true },
  { key: "error", label: "Last error", value: last, text: (row) => last(row) || "–" },
];

export function blockTable(choose) {
  const body = document.querySelector("#block-table tbody");
  const scroll = byId("block-scroll");
  const view = { rows: [], shown: [], key: "block", down: false, marked: null, curves: new Set() };
  const spacers = [el("tr", { class: "spacer", "aria-hidden": "true" }), el("tr", { class: "spacer", "aria-hidden": "true" })];

  for (const column of COLUMNS) {
    const button = el("button", { type: "button", class: "sorter", on: { click: () => sortBy(column.key) } }, column.label);
    document.querySelector("#block-table thead tr").append(el("th", { scope: "col", class: column.number ? "number" : null, "data-column": column.key }, button));
  }

  function sortBy(key) {
    view.down = view.key === key && !view.down;
    view.key = key;
    arrange();
  }

  function arrange() {
    const words = byId("block-search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const text = (row) => `${taskLabel(row.name)} ${row.status} ${row.node ?? ""} ${row.device} ${last(row)}`.toLowerCase();
    const { value } = COLUMNS.find((column) => column.key === view.key);
    const sign = view.down ? -1 : 1;
    view.shown = view.rows.filter((row) => words.every((word) => text(row).includes(word))).sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      const [noX, noY] = [x === null || x === undefined || x === "", y === null || y === undefined || y === ""];
      if (noX || noY) return noX - noY || a.block - b.block;
      return sign * (typeof x === "string" ? x.localeCompare(y) : x - y) || a.block - b.block;
    });
    for (const head of document.querySelectorAll("#block-table th")) {
      head.setAttribute("aria-sort", head.dataset.column !== view.key ? "none" : view.down ? "descending" : "ascending");
    }
    byId("block-table").setAttribute("aria-rowcount", view.shown.length + 1);
    scroll.classList.toggle("many", view.shown.length > MANY);
    paint();
  }

  function make() {
    const cells = COLUMNS.map((column) => {
      const cell = el("td", { class: column.number ? "number" : null, "data-column": column.key });
      if (column.key === "block") cell.append(el("span", { class: "chip" }), el("button", { type: "button", class: "row-name" }));
      if (column.key === "status") cell.append(pill("waiting"));
      if (column.key === "iteration") cell.append(el("span"), el("progress", { max: 1, value: 0 }));
      return cell;
    });
    const row = el("tr", {}, cells);
    row.addEventListener("click", () => choose.block(Number(row.dataset.block)));
    return row;
  }

  function fill(node, row, index) {
    const cell = (i) => node.children[i];
    node.dataset.block = row.block;
    node.setAttribute("aria-rowindex", index + 2);
    node.setAttribute("aria-current", row.block === view.marked ? "true" : "false");
    cell(0).firstChild.style.background = view.color?.(row.block) ?? "transparent";
    setText(cell(0).lastChild, taskLabel(row.name));
    setPill(cell(1).firstChild, row.status);
    setText(cell(2).firstChild, row.iterations ? `${count(row.iteration ?? 0)} / ${count(row.iterations)}` : "–");
    const progress = cell(2).lastChild;
    progress.value = share(row);
    progress.parentElement.dataset.status = row.status;
    progress.setAttribute("aria-label", `progress of ${taskLabel(row.name)}`);
    COLUMNS.forEach((column, i) => { if (column.text) setText(cell(i), column.text(row)); });
    cell(COLUMNS.length - 1).title = last(row);
  }

  /** Puts the rows in sight into the page, and empty ones as high as all others around them. */
  function paint() {
    const [top, height] = scroll.classList.contains("many") ? [scroll.scrollTop, scroll.clientHeight] : [0, Infinity];
    const first = Math.max(Math.floor(top / ROW) - SPARE, 0);
    const end = Math.min(Math.ceil((top + height) / ROW) + SPARE, view.shown.length);
    const rows = [...body.children].filter((node) => !node.classList.contains("spacer"));
    while (rows.length > end - first) rows.pop().remove();
    while (rows.length < end - first) rows.push(make());
    spacers[0].style.height = `${first * ROW}px`;
    spacers[1].style.height = `${(view.shown.length - end) * ROW}px`;
    if (rows[0]?.parentElement !== body || body.lastChild !== spacers[1] || body.children.length !== rows.length + 2) {
      body.replaceChildren(spacers[0], ...rows, spacers[1]);
    }
    rows.forEach((node, i) => fill(node, view.shown[first + i], first + i));
  }

  scroll.addEventListener("scroll", () => requestAnimationFrame(paint), { passive: true });
  byId("block-search").addEventListener("input", () => { scroll.scrollTop = 0; arrange(); });

  return {
    update(run, rows) {
      view.rows = rows;
      const blocks = rows.filter((row) => row.block >= 0);
      const tally = Object.entries(Object.groupBy(blocks, (row) => row.status)).map(([status, some]) => `${some.length} ${status}`);
      setText(byId("tally"), tally.join(" · "));
      arrange();
    },
    /** Marks the row of a block and brings it into sight. */
    mark(block) {
      view.marked = block;
      const index = view.shown.findIndex((row) => row.block === block);
      const [top, bottom] = [index * ROW, (index + 2) * ROW];
      if (index >= 0 && scroll.classList.contains("many") && (top < scroll.scrollTop || bottom > scroll.scrollTop + scroll.clientHeight)) {
        scroll.scrollTop = top - scroll.clientHeight / 2;
      }
      paint();
    },
    /** How to find a block's colour. */
    colored(color) {
      view.color = color;
      paint();
    },
  };
}
