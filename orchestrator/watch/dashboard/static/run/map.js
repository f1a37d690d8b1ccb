// The partition from above: cells by status and progress, points, and cameras by the blocks that they train.

import { BLOCK_STATUSES, STATES } from "panolog/run/rows.js";
/** @import { Chart, MapFigure, Trace } from "../shared/plotly.js" */
/** @import { RunPage } from "../shared/messages.js" */
/** @import { Choose } from "./run.js" */
import { get, messageOf } from "panolog/shared/api.js";
import { narrow } from "panolog/shared/charts.js";
import { byId, el, setText, throttled, token } from "panolog/shared/dom.js";
import { percent } from "panolog/shared/format.js";
import { draw, plotly, themed, unpack } from "panolog/shared/plot.js";

const STEP = 1.6; // of one zoom
const PAUSE = 900; // milliseconds between two drawings
const OPEN = 0.14; // opacity of the part of a cell that is still to do
const FULL = 0.42; // and of what is done
const MARK = 60; // of 255, added to the opacity of the selected block
/** A mark for each state, next to the number of a block: its colour alone says nothing to many. @type {Record<string, string>} */
const MARKS = { done: "✓", failed: "✕", paused: "‖", running: "▸" };
/** Sign and meaning of what else the map has, and which part of it that is; null: what only a plan has. @type {[string, string, string | null][]} */
const MARKED = [
  ["●", "camera", "cameras"],
  ["◎", "rings: other blocks that it trains", null],
  ["∴", "points", "points"],
  ["+", "GPS", "fixes"],
  ["╌", "box, beyond which cells bend", null],
];
const coarse = matchMedia("(pointer: coarse)"); // a finger on the map scrolls the page

/** @param {string} color @param {number} alpha */
const withAlpha = (color, alpha) =>
  color.replace(/rgba?\(([^)]*)\)/, (_, parts) => `rgba(${parts.split(",").slice(0, 3)},${alpha})`);

/** For each status the colour of the open and of the filled part of a cell, as [red, green, blue, alpha] bytes. */
function tints() {
  return BLOCK_STATUSES.flatMap((status) => {
    const tone = (token(`--cell-${status === "kept" ? "waiting" : status}`).match(/[\d.]+/g) ?? [])
      .slice(0, 3)
      .map(Number);
    return [
      [...tone, 255 * OPEN],
      [...tone, 255 * FULL],
    ];
  });
}

/** A colour as one number of a picture's buffer. @param {number[]} color bytes @param {number} more added to its opacity */
function pixel([red, green, blue, alpha], more) {
  return new Uint32Array(Uint8ClampedArray.of(red, green, blue, alpha + more).buffer)[0];
}

/** For each pixel the share of its block's pixels in the rows below it: the block fills up to its progress. @param {number[][]} rows */
function levelsOf(rows) {
  /** @type {Map<number, number>} */
  const counts = new Map();
  const ranks = rows.map((row) => {
    const below = row.map((block) => counts.get(block) ?? 0);
    for (const block of row) counts.set(block, (counts.get(block) ?? 0) + 1);
    return below;
  });
  return ranks.map((row, i) => Float32Array.from(row, (rank, j) => rank / (counts.get(rows[i][j]) ?? 1)));
}

/** @typedef {ReturnType<typeof planMap>} PlanMap */

/** @param {string} path of the run below /api @param {Choose} choose */
export function planMap(path, choose) {
  const plot = /** @type {Chart} */ (byId("map-plot"));
  const layerSelect = byId("layer", HTMLSelectElement);
  /** The figure of the server, with what its layer changes. @type {MapFigure | null} */
  let figure = null;
  /** The blocks of the lowest layer, by pixel and by label. @type {{cells: number[][], labels: number[]}} */
  let base = { cells: [], labels: [] };
  /** The blocks of the layer shown, by pixel. @type {number[][]} */
  let cells = [];
  /** @type {Float32Array[]} */
  let levels = [];
  /** @type {Map<number, [string, number]>} */
  let statuses = new Map();
  let requested = ""; // the plan that the figure is of
  /** @type {{block: number | null, row: number | null}} */
  let marked = { block: null, row: null };
  let drawn = "";
  let marks = ""; // the states that the labels show

  /** @param {string} name @returns {Trace} */
  const trace = (name) => figure?.data.find((item) => item.name === name) ?? { name };
  /** @returns {number[]} */
  const cameraRows = () => (figure ? trace("cameras").customdata : []);
  const cameras = () => (figure?.data ?? []).filter((item) => item.name.startsWith("cameras"));
  /** @param {number} block @returns {[string, number]} */
  const statusOf = (block) => statuses.get(block) ?? ["waiting", 0];

  async function load() {
    try {
      figure = /** @type {MapFigure} */ (await get(`${path}/map`));
    } catch (error) {
      requested = ""; // tried again with the next message
      setText(byId("map-empty"), messageOf(error));
      return;
    }
    const { layers, layer, colors } = figure.blocks;
    for (const item of cameras()) item.meta = item.marker.size;
    base = { cells: unpack(trace("blocks").z), labels: trace("labels").customdata };
    levels = levelsOf(base.cells);
    byId("layer-label").hidden = layers < 2;
    layerSelect.replaceChildren(
      ...Array.from({ length: layers }, (_, i) => el("option", { value: i }, `${i + 1} of ${layers}`)),
    );
    layerSelect.value = String(layer);
    shift(figure);
    byId("map-empty").hidden = true;
    byId("legend").hidden = false;
    const { planned } = figure.blocks;
    const drawn = MARKED.filter(([, , part]) => (part === null ? planned : part === "points" || trace(part).x?.length));
    byId("legend").replaceChildren(
      ...drawn.map(([mark, text]) => el("li", { class: "mark" }, el("span", { "aria-hidden": "true" }, mark), text)),
      ...(planned ? BLOCK_STATUSES : []).map((status) =>
        el("li", { "data-block-status": status }, `${MARKS[status] ?? ""} ${STATES[status] ?? status}`),
      ),
      ...figure.blocks.grades.map(([text, color]) => el("li", { class: "grade", style: `--tone: ${color}` }, text)),
    );
    const [across, up] = [figure.layout.xaxis, figure.layout.yaxis].map(({ range: [low, high] }) => high - low);
    plot.style.setProperty("--shape", String(across / up));
    plot.hidden = false; // before it is drawn: plotly measures it
    choose.mapped(colors);
    await render();
    for (const event of ["click", "hover", "unhover"]) plot.removeAllListeners?.(`plotly_${event}`);
    plot.on("plotly_click", ({ points: [{ data, customdata }] }) => {
      if (data.name.startsWith("cameras")) choose.camera(customdata);
      else if (figure?.blocks.planned && data.name !== "seams") choose.block(Number(customdata));
    });
    plot.on("plotly_hover", ({ points: [{ data, customdata }] }) => {
      const block = figure?.blocks.planned && (data.name === "blocks" || data.name === "labels");
      setText(byId("pointed"), block ? describe(Number(customdata)) : data.name === "seams" ? data.text : "");
    });
    plot.on("plotly_unhover", () => setText(byId("pointed"), ""));
  }

  /** Changes to the selected layer. @param {MapFigure} figure */
  function shift({ blocks }) {
    const by = (Number(layerSelect.value) - blocks.layer) * blocks.stride;
    cells = base.cells.map((row) => row.map((block) => block + by));
    const labels = trace("labels");
    labels.customdata = base.labels.map((block) => block + by);
    labels.marker.line.color = labels.customdata.map((/** @type {number} */ block) => blocks.colors[block]);
  }

  /** The cells as a picture of their own: redrawing it is fast, however many cameras are above it. @param {MapFigure} figure */
  function picture({ blocks }) {
    const colors = tints();
    const known = Array.from({ length: blocks.count }, (_, block) => {
      const [status, share] = statusOf(block);
      const code = 2 * Math.max(BLOCK_STATUSES.indexOf(status), 0);
      const [open, filled] = colors
        .slice(code, code + 2)
        .map((color) => pixel(color, block === marked.block ? MARK : 0));
      return { open, filled, share };
    });
    const [rows, columns] = [cells.length, cells[0].length];
    const canvas = Object.assign(document.createElement("canvas"), { width: columns, height: rows });
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    const image = context.createImageData(columns, rows);
    const pixels = new Uint32Array(image.data.buffer);
    cells.forEach((row, i) =>
      row.forEach((block, j) => {
        const { open, filled, share } = known[block];
        pixels[(rows - 1 - i) * columns + j] = levels[i][j] < share ? filled : open;
      }),
    );
    context.putImageData(image, 0, 0);
    return canvas.toDataURL();
  }

  /** Updates the text for screen readers. */
  function label() {
    drawn = key();
    if (!figure?.blocks.planned) {
      const cameras = cameraRows().length;
      const what = cameras ? `The ${cameras} cameras and the points` : "Where GPS has the panoramas,";
      return plot.setAttribute("aria-label", `${what} from above`);
    }
    const shares = [...statuses.values()].map(([, share]) => share);
    const done = percent(shares.reduce((sum, share) => sum + share, 0) / Math.max(shares.length, 1));
    const groups = Object.entries(Object.groupBy(statuses.values(), ([status]) => status));
    const tally = groups.map(([status, some]) => `${some?.length} ${status}`).join(", ");
    plot.setAttribute("aria-label", `The partition from above: ${shares.length} blocks (${tally}), ${done} done`);
  }

  async function repaint() {
    if (!figure?.blocks.planned || !plot.layout) return;
    if (plot._dragging) return soon(); // plotly would end the drag
    if (marks !== states()) return render();
    label();
    await (await plotly()).relayout(plot, { "images[0].source": picture(figure) });
  }

  /** Applies the theme, the width of the page and what is selected. */
  function style() {
    trace("blocks").customdata = cells; // invisible, for the pointer
    const [ink, surface, text, line] = ["--points", "--surface", "--ink", "--line-strong"].map(token);
    trace("points").colorscale = [
      [0, withAlpha(ink, 0)],
      [0.02, withAlpha(ink, 0.3)],
      [1, withAlpha(ink, 0.95)],
    ];
    for (const name of ["faces", "box"]) trace(name).line.color = line;
    trace("fixes").marker.line.color = text;
    const labels = trace("labels");
    /** @type {number[]} */
    const ids = labels.customdata;
    const scale = narrow.matches ? 0.7 : 1;
    labels.marker.color = surface;
    labels.textfont.color = text;
    labels.textfont.size = narrow.matches ? 10 : 12;
    labels.text = ids.map((block) => `${block}${MARKS[statusOf(block)[0]] ?? ""}`);
    labels.marker.size = ids.map(
      (block, i) => scale * ((block === marked.block ? 34 : 26) + 6 * Math.max(labels.text[i].length - 2, 0)),
    );
    marks = states();
    labels.marker.line.width = ids.map((block) => (block === marked.block ? 4 : 2));
    for (const item of cameras()) {
      const size = scale * item.meta;
      /** @type {number[]} */
      const rows = item.customdata;
      item.marker.line.color = surface;
      item.marker.size = item.name === "cameras" ? rows.map((row) => size * (row === marked.row ? 1.9 : 1)) : size;
    }
  }

  async function render() {
    if (!figure) return;
    style();
    label();
    const layout = themed(figure.layout);
    if (narrow.matches) for (const axis of [layout.xaxis, layout.yaxis]) axis.title = { text: "" };
    const { x0, dx, y0, dy } = trace("blocks");
    const [rows, columns] = [cells.length, cells[0].length];
    const image = {
      source: picture(figure),
      xref: "x",
      yref: "y",
      layer: "below",
      sizing: "stretch",
      x: x0 - dx / 2,
      y: y0 + (rows - 0.5) * dy,
      sizex: columns * dx,
      sizey: rows * dy,
    };
    const data = figure.data.map((item) => ({ ...item }));
    await draw(plot, data, {
      ...layout,
      images: figure.blocks.planned ? [image] : [],
      dragmode: coarse.matches ? false : "pan",
    });
  }

  const key = () =>
    JSON.stringify([...statuses].map(([block, [status, share]]) => [block, status, Math.floor(share * 200)]));
  const states = () => [...statuses.values()].map(([status]) => status).join();
  const soon = throttled(repaint, PAUSE);

  /** @param {number} block */
  function describe(block) {
    const [status, share] = statusOf(block);
    return `block ${block}: ${status}${status === "done" || status === "kept" ? "" : ` ${percent(share)}`}`;
  }

  /** Zooms by a factor, or to the whole map with 0. @param {number} factor */
  async function zoom(factor) {
    if (!figure || !plot.layout) return;
    /** @type {Record<string, [number, number]>} */
    const ranges = {};
    for (const axis of /** @type {const} */ (["xaxis", "yaxis"])) {
      const [low, high] = (factor ? plot.layout : figure.layout)[axis].range;
      const [middle, half] = [(low + high) / 2, (high - low) / 2 / (factor || 1)];
      ranges[`${axis}.range`] = [middle - half, middle + half];
    }
    await (await plotly()).relayout(plot, ranges);
  }

  byId("zoom-in").addEventListener("click", () => zoom(STEP));
  byId("zoom-out").addEventListener("click", () => zoom(1 / STEP));
  byId("zoom-all").addEventListener("click", () => zoom(0));
  layerSelect.addEventListener("change", () => {
    if (figure) shift(figure);
    render();
  });
  document.addEventListener("themechange", render);
  narrow.addEventListener("change", render);
  // Also when the window stays as it is: a scroll bar that appears makes the card narrower.
  new ResizeObserver(async () => {
    if (plot.layout && plot.offsetWidth) (await plotly()).Plots.resize(plot);
  }).observe(plot);

  return {
    /** @param {RunPage} run @param {Map<number, [string, number]>} current */
    update({ summary: { blocks }, result }, current) {
      statuses = current;
      const plan = blocks.length ? JSON.stringify(blocks) : (result.outline ?? (result.map ? "outline" : ""));
      if (plan && plan !== requested) {
        requested = plan;
        load();
      } else if (figure && key() !== drawn) soon();
    },
    /** Marks a block or a camera. @param {number | null} block @param {number | null} row */
    mark(block, row = null) {
      const cellsOnly = marked.row === row && trace("labels").customdata?.length === 0;
      marked = { block, row };
      if (cellsOnly) repaint();
      else render();
    },
    /** Rows and names of the cameras, for the keyboard. @returns {{row: number, name: string}[]} */
    cameras: () => cameraRows().map((row, i) => ({ row, name: figure?.blocks.names[i] ?? "" })),
  };
}
