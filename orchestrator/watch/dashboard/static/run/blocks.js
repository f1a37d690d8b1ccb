// The table of Stage I and all blocks. Only the visible rows are in the page, so a thousand cost no more than thirty.

import { lastError, STATES } from "panolog/run/rows.js";
/** @import { Choose } from "./run.js" */
/** @import { Row } from "./rows.js" */
import {
  addHeadings,
  bar,
  byId,
  childrenOf,
  compare,
  el,
  first,
  markSorted,
  matches,
  pill,
  setBar,
  setPill,
  setText,
} from "panolog/shared/dom.js";
import { bytes, count, duration, fixed, short, significant, taskLabel } from "panolog/shared/format.js";

const ROW = 44; // pixels, as in run.css
const MARGIN = 8; // rows beyond each edge
const MANY = 12; // rows from which on the table scrolls by itself

/** @typedef {{key: string, label: string, value: (row: Row) => string | number | null | undefined, text?: (row: Row) => string, number?: boolean}} Column */

/** @param {Row} row */
const gaussians = (row) => row.gaussians ?? row.plan?.gaussians;
/** @param {Row} row */
const rate = (row) => (row.status === "running" ? row.rate : null);
/** @type {Column[]} */
const COLUMNS = [
  { key: "block", label: "Block", value: (row) => row.place },
  { key: "status", label: "State", value: (row) => row.status },
  { key: "iteration", label: "Iteration", value: (row) => row.share, number: true },
  { key: "rate", label: "it/s", value: rate, text: (row) => fixed(rate(row), 1), number: true },
  { key: "eta", label: "ETA", value: (row) => row.eta, text: (row) => duration(row.eta), number: true },
  { key: "seconds", label: "Time", value: (row) => row.seconds, text: (row) => duration(row.seconds), number: true },
  {
    key: "cameras",
    label: "Cameras",
    value: (row) => row.plan?.cameras,
    text: (row) => count(row.plan?.cameras),
    number: true,
  },
  { key: "loss", label: "Loss", value: (row) => row.loss, text: (row) => significant(row.loss), number: true },
  { key: "psnr", label: "PSNR", value: (row) => row.psnr, text: (row) => fixed(row.psnr), number: true },
  { key: "gaussians", label: "Gaussians", value: gaussians, text: (row) => short(gaussians(row)), number: true },
  { key: "memory", label: "Memory", value: (row) => row.memory, text: (row) => bytes(row.memory), number: true },
  { key: "node", label: "Node", value: (row) => row.node, text: (row) => row.node ?? "–" },
  { key: "device", label: "Device", value: (row) => row.device, text: (row) => row.device || "–" },
  { key: "retries", label: "Retries", value: (row) => row.retries, text: (row) => count(row.retries), number: true },
  { key: "error", label: "Last error", value: lastError, text: (row) => lastError(row) || "–" },
];

/** @typedef {ReturnType<typeof blockTable>} BlockTable */

/** @param {Choose} choose */
export function blockTable(choose) {
  const body = first("#block-table tbody");
  const [scroll, search] = [byId("block-scroll"), byId("block-search", HTMLInputElement)];
  /** @type {{rows: Row[], shown: Row[], key: string, down: boolean, marked: number | null, color: (row: Row) => string}} */
  const view = { rows: [], shown: [], key: "block", down: false, marked: null, color: () => "transparent" };
  const spacers = [
    el("tr", { class: "spacer", "aria-hidden": "true" }),
    el("tr", { class: "spacer", "aria-hidden": "true" }),
  ];

  addHeadings("#block-table", COLUMNS, (key) => {
    view.down = view.key === key && !view.down;
    view.key = key;
    arrange();
  });

  function arrange() {
    /** @param {Row} row */
    const text = (row) => `${taskLabel(row.name)} ${row.status} ${row.node ?? ""} ${row.device} ${lastError(row)}`;
    const { value } = COLUMNS.find((column) => column.key === view.key) ?? COLUMNS[0];
    view.shown = view.rows.filter((row) => matches(text(row), search.value));
    view.shown.sort((a, b) => compare(value(a), value(b), view.down) || a.place - b.place);
    markSorted("#block-table", view.key, view.down);
    byId("block-table").setAttribute("aria-rowcount", String(view.shown.length + 1));
    scroll.classList.toggle("many", view.shown.length > MANY);
    paint();
  }

  function make() {
    const cells = COLUMNS.map((column) => {
      const cell = el("td", { class: column.number ? "number" : null, "data-column": column.key });
      if (column.key === "block")
        cell.append(el("span", { class: "chip" }), el("button", { type: "button", class: "row-name" }));
      if (column.key === "status") cell.append(pill("waiting"));
      if (column.key === "iteration") cell.append(el("span"), bar(0, "progress"));
      return cell;
    });
    const row = el("tr", {}, cells);
    row.addEventListener("click", () => choose.block(Number(row.dataset.block)));
    return row;
  }

  /** @param {HTMLElement} node @param {Row} row @param {number} index */
  function fill(node, row, index) {
    const cells = childrenOf(node);
    node.dataset.block = String(row.block);
    node.setAttribute("aria-rowindex", String(index + 2));
    node.setAttribute("aria-current", String(row.block === view.marked));
    const [chip, name] = childrenOf(cells[0]);
    chip.style.background = view.color(row);
    setText(name, taskLabel(row.name));
    setPill(childrenOf(cells[1])[0], row.status, STATES[row.status]);
    const [iterations, progress] = childrenOf(cells[2]);
    setText(iterations, row.iterations ? `${count(row.iteration ?? 0)} / ${count(row.iterations)}` : "–");
    setBar(progress, row.kept ? 0 : row.share, `progress of ${taskLabel(row.name)}`);
    cells[2].dataset.status = row.status;
    COLUMNS.forEach(({ text }, i) => {
      if (text) setText(cells[i], text(row));
    });
    cells[COLUMNS.length - 1].title = lastError(row);
  }

  /** Fills the page with the visible rows, between two spacers as high as all others. */
  function paint() {
    const [top, height] = scroll.classList.contains("many") ? [scroll.scrollTop, scroll.clientHeight] : [0, Infinity];
    const start = Math.max(Math.floor(top / ROW) - MARGIN, 0);
    const end = Math.min(Math.ceil((top + height) / ROW) + MARGIN, view.shown.length);
    const rows = childrenOf(body).filter((node) => !node.classList.contains("spacer"));
    while (rows.length > end - start) rows.pop()?.remove();
    while (rows.length < end - start) rows.push(make());
    spacers[0].style.height = `${start * ROW}px`;
    spacers[1].style.height = `${(view.shown.length - end) * ROW}px`;
    if (rows[0]?.parentElement !== body || body.lastChild !== spacers[1] || body.children.length !== rows.length + 2) {
      body.replaceChildren(spacers[0], ...rows, spacers[1]);
    }
    rows.forEach((node, i) => fill(node, view.shown[start + i], start + i));
  }

  scroll.addEventListener("scroll", () => requestAnimationFrame(paint), { passive: true });
  search.addEventListener("input", () => {
    scroll.scrollTop = 0;
    arrange();
  });

  return {
    /** @param {Row[]} rows @param {boolean} running whether the run is */
    update(rows, running) {
      view.rows = rows;
      byId("block-table").classList.toggle("ended", !running);
      const groups = Object.groupBy(
        rows.filter((row) => row.block >= 0),
        (row) => row.status,
      );
      setText(
        byId("tally"),
        Object.entries(groups)
          .map(([status, some]) => `${some?.length} ${status}`)
          .join(" · "),
      );
      arrange();
    },
    /** Marks the row of a block and scrolls to it. @param {number | null} block */
    mark(block) {
      view.marked = block;
      const index = view.shown.findIndex((row) => row.block === block);
      const [top, bottom] = [index * ROW, (index + 2) * ROW];
      if (
        index >= 0 &&
        scroll.classList.contains("many") &&
        (top < scroll.scrollTop || bottom > scroll.scrollTop + scroll.clientHeight)
      ) {
        scroll.scrollTop = top - scroll.clientHeight / 2;
      }
      paint();
    },
    /** Sets the colours of blocks. @param {(row: Row) => string} color */
    colored(color) {
      view.color = color;
      paint();
    },
  };
}
