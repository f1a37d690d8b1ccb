// Loss, PSNR, Gaussians, speed, memory and learning rates over the iterations of Stage I and of blocks.

import { get } from "./api.js";
import { byId, el, throttled, token } from "./dom.js";
import { blockOf, taskLabel } from "./format.js";
import { draw, themed } from "./plot.js";

const CHARTS = [
  { key: "loss", title: "Loss" },
  { key: "psnr", title: "PSNR of training views, dB" },
  { key: "gaussians", title: "Gaussians" },
  { key: "rate", title: "Iterations per second" },
  { key: "memory", title: "Memory, bytes" },
  { key: "rate/", title: "Learning rates", log: true },
];
const POINTS = 600;
const FIRST = 4; // curves that are shown before anybody chooses
const MOST = 8;
const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot"]; // one for each parameter

export function curves(path, table) {
  const data = new Map(); // task → name → {iteration, value}
  let shown = null; // tasks, null until there is something to show
  let rows = [];
  let settled = false; // somebody has chosen, or there are enough
  const nodes = CHARTS.map(({ title }) => el("div", { class: "plot chart", role: "img", "aria-label": title }));
  byId("charts").append(...CHARTS.map(({ title }, i) => el("figure", {}, el("figcaption", {}, title), nodes[i])));

  const color = (block) => {
    if (block === null || block < 0) return token("--ink");
    return color.blocks?.[block] ?? token("--accent");
  };
  table.colored((block) => (block < 0 ? "var(--ink)" : color.blocks?.[block] ?? "transparent"));

  async function load(task) {
    try {
      data.set(task, await get(`${path}/series?task=${encodeURIComponent(task)}&points=${POINTS}`));
      soon();
    } catch (error) {
      if (error.status !== 404) throw error; // nothing to show yet
    }
  }

  function traces(chart) {
    const lines = [];
    for (const task of shown ?? []) {
      for (const [name, series] of Object.entries(data.get(task) ?? {})) {
        const rate = chart.key === "rate/" && name.startsWith("rate/");
        if (name !== chart.key && !rate) continue;
        const part = rate ? name.slice(5) : "";
        const names = Object.keys(data.get(task)).filter((one) => one.startsWith("rate/"));
        lines.push({
          type: "scatter", mode: series.value.length > 1 ? "lines" : "markers", x: series.iteration, y: series.value,
          name: [taskLabel(task), part].filter(Boolean).join(" "),
          line: { color: color(blockOf(task)), width: 1.7, dash: rate ? DASHES[names.indexOf(name) % DASHES.length] : "solid" },
          hovertemplate: "%{y:.4~g}",
        });
      }
    }
    return lines;
  }

  async function render() {
    if (!shown) return;
    await Promise.all(CHARTS.map((chart, i) => {
      const layout = {
        margin: { l: 8, r: 10, t: 6, b: 8 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false,
        hovermode: "x unified", dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom", uirevision: "curves",
        font: { family: "system-ui, sans-serif", size: 11.5 },
        xaxis: { automargin: true, rangemode: "tozero", zeroline: false, nticks: 6 },
        yaxis: { automargin: true, type: chart.log ? "log" : "linear", zeroline: false, ...(chart.log ? { dtick: 1, exponentformat: "power" } : { nticks: 6, exponentformat: "SI" }) },
      };
      return draw(nodes[i], traces(chart), themed(layout));
    }));
  }
  const soon = throttled(render, 1000);

  function chips() {
    const offered = rows.filter((row) => row.iteration !== null && row.iteration !== undefined);
    const chip = (row) => {
      const on = shown?.has(row.name);
      const mark = el("span", { class: "chip" });
      mark.style.background = color(row.block);
      return el("button", { type: "button", class: "chip-button", "data-task": row.name, "aria-pressed": String(Boolean(on)), on: { click: () => toggle(row.name, !on) } }, mark, taskLabel(row.name));
    };
    const chosen = offered.filter((row, i) => shown?.has(row.name) || i < MOST);
    const present = [...byId("shown").children].map((node) => node.dataset.task + node.getAttribute("aria-pressed")).join();
    const wanted = chosen.map((row) => row.name + String(Boolean(shown?.has(row.name)))).join();
    if (present === wanted && chips.colors === color.blocks) return;
    const focused = byId("shown").contains(document.activeElement) ? document.activeElement.dataset.task : null;
    chips.colors = color.blocks;
    byId("shown").replaceChildren(...chosen.map(chip));
    if (focused) byId("shown").querySelector(`[data-task="${focused}"]`)?.focus();
  }

  function toggle(task, on) {
    shown ??= new Set();
    settled = true;
    if (on) {
      shown.add(task);
      while (shown.size > MOST) shown.delete(shown.values().next().value);
      load(task);
    } else shown.delete(task);
    chips();
    render();
  }

  /** Until somebody chooses, Stage I and the first blocks that have begun. */
  function begin() {
    const begun = rows.filter((row) => row.iteration !== null && row.iteration !== undefined).map((row) => row.name);
    if (settled || !begun.length) return;
    shown ??= new Set();
    for (const task of begun.slice(0, FIRST)) {
      if (!shown.has(task)) {
        shown.add(task);
        load(task);
      }
    }
    settled = shown.size >= FIRST;
  }

  document.addEventListener("themechange", () => { chips.colors = null; chips(); render(); });

  return {
    toggle,
    shown: (task) => Boolean(shown?.has(task)),
    refresh() {
      for (const task of shown ?? []) load(task);
    },
    /** New records: the points of the curves that are shown. Those that came before the curves were loaded do not matter. */
    add(events) {
      for (const event of [...events].reverse()) {
        const known = event.type === "Progressed" && shown?.has(event.task) ? data.get(event.task) : null;
        if (!known) continue;
        const values = { loss: event.loss, psnr: event.psnr, gaussians: event.gaussians, rate: event.rate, memory: event.memory };
        for (const [name, rate] of Object.entries(event.rates ?? {})) values[`rate/${name}`] = rate;
        for (const [name, value] of Object.entries(values)) if (value !== null && value !== undefined) extend(known, name, event.iteration, value);
        if (Object.values(known).some((series) => series.iteration.length > 3 * POINTS)) load(event.task); // thinned anew
        soon();
      }
    },
    update(run, tasks) {
      rows = tasks;
      begin();
      chips();
    },
    colors(blocks) {
      color.blocks = blocks;
      table.colored((block) => (block < 0 ? "var(--ink)" : blocks[block] ?? "transparent"));
      chips();
      render();
    },
  };
}

/** One more point; what lies beyond it was lost with a worker and is done again. */
function extend(known, name, iteration, value) {
  const series = (known[name] ??= { iteration: [], value: [] });
  while (series.iteration.length && series.iteration.at(-1) >= iteration) {
    series.iteration.pop();
    series.value.pop();
  }
  series.iteration.push(iteration);
  series.value.push(value);
}
