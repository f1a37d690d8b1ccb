// Loss, PSNR, Gaussians, speed, memory and learning rates over the iterations of Stage I and of blocks.

/** @import { TaskSeries } from "../shared/charts.js" */
/** @import { RunEvent } from "../shared/messages.js" */
/** @import { BlockTable } from "./blocks.js" */
/** @import { Row } from "./rows.js" */
import { get, statusOf } from "panolog/shared/api.js";
import { CHARTS, chartLayout, chartTitle, chartTraces, narrow } from "panolog/shared/charts.js";
import { byId, el, replaceIfChanged, throttled, token } from "panolog/shared/dom.js";
import { taskLabel } from "panolog/shared/format.js";
import { draw, themed } from "panolog/shared/plot.js";

const POINTS = 600; // of a curve, as the server sends it
const FIRST = 4; // curves that are shown by default
const MOST = 8;
const OTHERS = ["--accent", "--paused", "--failed", "--done"];

/** The colour of what is no block: of Stage I, or of a repair by the number of its seam. @param {string} task */
function other(task) {
  const number = task.split("/")[1];
  return number === undefined ? "--ink" : OTHERS[Number(number) % OTHERS.length];
}

/** @param {string} path of the run below /api @param {BlockTable} table */
export function curves(path, table) {
  /** @type {Map<string, TaskSeries>} */
  const data = new Map();
  /** The tasks shown. @type {Set<string>} */
  const shown = new Set();
  /** Rows that have curves. @type {Row[]} */
  let begun = [];
  let settled = false; // the user has chosen, or there are enough
  /** @type {string[]} */
  let blockColors = [];
  const nodes = CHARTS.map((kind) => el("div", { class: "plot chart", role: "img", "aria-label": chartTitle(kind) }));
  byId("charts").append(...CHARTS.map((kind, i) => el("figure", {}, el("figcaption", {}, chartTitle(kind)), nodes[i])));
  const paint = () =>
    table.colored((row) => (row.block < 0 ? `var(${other(row.name)})` : (blockColors[row.block] ?? "transparent")));
  paint();

  /** @param {string} name @param {number} block -1 for what is no block */
  const color = (name, block) => (block < 0 ? token(other(name)) : (blockColors[block] ?? token("--accent")));

  /** @param {string} task */
  async function load(task) {
    try {
      data.set(task, await get(`${path}/series?task=${encodeURIComponent(task)}`));
      soon();
    } catch (error) {
      if (statusOf(error) !== 404) throw error; // nothing to show yet
    }
  }

  async function render() {
    if (!shown.size && !settled) return;
    const drawn = [...shown].map((task) => {
      const block = begun.find((row) => row.name === task)?.block ?? -1;
      return { label: taskLabel(task), color: color(task, block), series: data.get(task) ?? {} };
    });
    await Promise.all(CHARTS.map((kind, i) => draw(nodes[i], chartTraces(kind, drawn), themed(chartLayout(kind)))));
  }
  const soon = throttled(render, 1000);

  function chips() {
    const offered = begun.filter((row, i) => shown.has(row.name) || i < MOST);
    const key = [offered.map((row) => [row.name, shown.has(row.name)]), blockColors, token("--ink")];
    replaceIfChanged(byId("shown"), key, () =>
      offered.map(({ name, block }) => {
        const mark = el("span", { class: "chip" });
        mark.style.background = color(name, block);
        const on = shown.has(name);
        return el(
          "button",
          {
            type: "button",
            class: "chip-button",
            "data-task": name,
            "aria-pressed": String(on),
            on: { click: () => toggle(name, !on) },
          },
          mark,
          taskLabel(name),
        );
      }),
    );
  }

  /** @param {string} task @param {boolean} on */
  function toggle(task, on) {
    settled = true;
    shown.delete(task);
    if (on) {
      shown.add(task);
      for (const first of shown) if (shown.size > MOST) shown.delete(first);
      load(task);
    }
    chips();
    render();
  }

  document.addEventListener("themechange", () => {
    chips();
    render();
  });
  narrow.addEventListener("change", render);

  return {
    toggle,
    refresh() {
      for (const task of shown) load(task);
    },
    /** Adds new records to the curves shown; curves that are not loaded yet will have them. @param {RunEvent[]} events */
    add(events) {
      for (const event of [...events].reverse()) {
        const known = event.type === "Progressed" && shown.has(event.task) ? data.get(event.task) : null;
        if (!known) continue;
        const { loss, psnr, gaussians, rate, memory, rates = {} } = event;
        const learning = Object.fromEntries(Object.entries(rates).map(([name, value]) => [`rate/${name}`, value]));
        for (const [name, value] of Object.entries({ loss, psnr, gaussians, rate, memory, ...learning })) {
          if (value !== null && value !== undefined) extend(known, name, event.iteration, value);
        }
        if (Object.values(known).some((series) => series.iteration.length > 3 * POINTS)) load(event.task); // thinned again
        soon();
      }
    },
    /** Until the user chooses, Stage I and the first blocks that have begun are shown. @param {Row[]} rows */
    update(rows) {
      begun = rows.filter((row) => row.iteration !== null && row.iteration !== undefined);
      if (!settled && begun.length) {
        for (const { name } of begun.slice(0, FIRST)) {
          if (!shown.has(name)) {
            shown.add(name);
            load(name);
          }
        }
        settled = shown.size >= FIRST;
      }
      byId("charts").hidden = !begun.length;
      byId("charts-empty").hidden = begun.length > 0;
      chips();
    },
    /** @param {string[]} colors */
    colors(colors) {
      blockColors = colors;
      paint();
      chips();
      render();
    },
  };
}

/**
 * Adds a point. Points at later iterations were lost with a worker and are repeated.
 * @param {TaskSeries} known
 * @param {string} name
 * @param {number} iteration
 * @param {number} value
 */
function extend(known, name, iteration, value) {
  const series = (known[name] ??= { iteration: [], time: [], value: [] });
  while (series.iteration.length && (series.iteration.at(-1) ?? 0) >= iteration) {
    series.iteration.pop();
    series.value.pop();
  }
  series.iteration.push(iteration);
  series.value.push(value);
}
