// The partition from above: cells by status and progress, points, and cameras by the blocks that they train.

import { axes, frameOf, painted, pixel, placesOf, polyline, raster, unpack } from "panolog/run/drawing.js";
import { BLOCK_STATUSES, STATES } from "panolog/run/rows.js";
/** @import { MapFigure, Trace } from "./figure.js" */
/** @import { RunPage } from "../shared/messages.js" */
/** @import { Frame, Window } from "./drawing.js" */
/** @import { Choose } from "./run.js" */
import { get, messageOf } from "panolog/shared/api.js";
import { narrow } from "panolog/shared/charts.js";
import { byId, el, setText, svg, throttled, token } from "panolog/shared/dom.js";
import { percent } from "panolog/shared/format.js";

const STEP = 1.6; // of one zoom
const PAUSE = 900; // milliseconds between two drawings for what the server sends
const NEAR = 12; // pixels from a camera within which the pointer is on it
const CLICK = 3; // pixels by which the pointer moves in a click at most
const OPEN = 0.14; // opacity of the part of a cell that is still to do
const FULL = 0.42; // and of what is done
const MARK = 60; // of 255, added to the opacity of the selected block
/** A mark for each state, next to the number of a block: its colour alone says nothing to many. @type {Record<string, string>} */
const MARKS = { done: "✓", failed: "✕", paused: "‖", running: "▸" };
/** The sign of each part that the legend of the server has. @type {Record<string, string>} */
const SIGNS = { cameras: "●", rings: "◎", points: "∴", fixes: "+", box: "╌" };
const coarse = matchMedia("(pointer: coarse)"); // a finger on the map scrolls the page

/** A colour of the style sheet as bytes. @param {string} name */
const toneOf = (name) => (token(name).match(/[\d.]+/g) ?? []).slice(0, 3).map(Number);

/** For each pixel the share of its block's pixels in the rows below it: the block fills up to its progress. @param {ArrayLike<number>[]} rows */
function levelsOf(rows) {
  /** @type {Map<number, number>} */
  const counts = new Map();
  const ranks = rows.map((row) => {
    const blocks = Array.from(row);
    const below = blocks.map((block) => counts.get(block) ?? 0);
    for (const block of blocks) counts.set(block, (counts.get(block) ?? 0) + 1);
    return below;
  });
  return ranks.map((row, i) => Float32Array.from(row, (rank, j) => rank / (counts.get(rows[i][j]) ?? 1)));
}

/** The points as a picture. @param {ArrayLike<number>[]} rows how many there are, of 255 */
function shade(rows) {
  const tone = toneOf("--points");
  const colors = Array.from({ length: 256 }, (_, i) =>
    pixel([...tone, 255 * (i < 5 ? 0.06 * i : 0.3 + (0.65 * (i - 5)) / 250)]),
  );
  return painted(rows, (value) => colors[value]);
}

/** @typedef {ReturnType<typeof planMap>} PlanMap */

/** @param {string} path of the run below /api @param {Choose} choose */
export function planMap(path, choose) {
  const plot = byId("map-plot");
  const tip = el("p", { class: "tip", hidden: true });
  const layerSelect = byId("layer", HTMLSelectElement);
  /** The figure of the server, with what its layer changes. @type {MapFigure | null} */
  let figure = null;
  /** The blocks of the lowest layer. @type {ArrayLike<number>[]} */
  let cells = [];
  /** @type {Float32Array[]} */
  let levels = [];
  /** @type {ArrayLike<number>[]} */
  let density = [];
  let points = ""; // `shade` of the density
  let above = 0; // added to the blocks of the lowest layer: those of the layer shown
  /** @type {Map<number, [string, number]>} */
  let statuses = new Map();
  let requested = ""; // the plan that the figure is of
  /** @type {{block: number | null, row: number | null}} */
  let marked = { block: null, row: null };
  let drawn = "";
  /** The part that was zoomed to; null: all. @type {Window | null} */
  let zoomed = null;
  /** @type {Frame | null} */
  let frame = null;
  /** Where the pointer went down, and how far it has dragged the map. @type {{from: [number, number], by: [number, number]} | null} */
  let drag = null;
  let dragged = false; // whether the last click was the end of that

  /** @param {string} name @returns {Trace} */
  const trace = (name) => figure?.data.find((item) => item.name === name) ?? { name };
  /** @returns {number[]} */
  const cameraRows = () => trace("cameras").customdata ?? [];
  /** @param {number} block @returns {[string, number]} */
  const statusOf = (block) => statuses.get(block) ?? ["waiting", 0];
  /** @param {MapFigure} figure @returns {Window} */
  const whole = ({ layout: { xaxis, yaxis } }) => [xaxis.range[0], xaxis.range[1], yaxis.range[0], yaxis.range[1]];

  async function load() {
    try {
      figure = /** @type {MapFigure} */ (await get(`${path}/map`));
    } catch (error) {
      requested = ""; // tried again with the next message
      setText(byId("map-empty"), messageOf(error));
      return;
    }
    const { layers, layer, colors } = figure.blocks;
    cells = figure.blocks.planned ? unpack(trace("blocks").z) : [];
    levels = levelsOf(cells);
    density = unpack(trace("points").z);
    points = shade(density);
    byId("layer-label").hidden = layers < 2;
    layerSelect.replaceChildren(
      ...Array.from({ length: layers }, (_, i) => el("option", { value: i }, `${i + 1} of ${layers}`)),
    );
    layerSelect.value = String(layer);
    byId("map-empty").hidden = true;
    legend(figure);
    const [left, right, bottom, top] = whole(figure);
    plot.style.setProperty("--shape", String((right - left) / (top - bottom)));
    plot.hidden = false;
    draw();
    choose.mapped(colors);
  }

  /** @param {MapFigure} figure */
  function legend({ blocks: { planned, legend, grades } }) {
    byId("legend").hidden = false;
    byId("legend").replaceChildren(
      ...legend.map(([part, text]) =>
        el("li", { class: "mark" }, el("span", { "aria-hidden": "true" }, SIGNS[part]), text),
      ),
      ...(planned ? BLOCK_STATUSES : []).map((status) =>
        el("li", { "data-block-status": status }, `${MARKS[status] ?? ""} ${STATES[status] ?? status}`),
      ),
      ...grades.map(([text, color]) => el("li", { class: "grade", style: `--tone: ${color}` }, text)),
    );
  }

  /** The cells by status and progress. @param {MapFigure} figure */
  function picture({ blocks }) {
    const tones = BLOCK_STATUSES.map((status) => toneOf(`--cell-${status === "kept" ? "waiting" : status}`));
    const known = Array.from({ length: blocks.count }, (_, block) => {
      const [status, share] = statusOf(block);
      const tone = tones[Math.max(BLOCK_STATUSES.indexOf(status), 0)];
      const more = block === marked.block ? MARK : 0;
      const [open, filled] = [OPEN, FULL].map((opacity) => pixel([...tone, 255 * opacity + more]));
      return { open, filled, share };
    });
    return painted(cells, (block, i, j) => {
      const { open, filled, share } = known[block + above];
      return levels[i][j] < share ? filled : open;
    });
  }

  /** The number of each block on a disc. @param {MapFigure} figure @param {Frame} frame */
  function labels({ blocks }, frame) {
    const scale = narrow.matches ? 0.7 : 1;
    const ids = blocksOf(trace("labels"));
    return placesOf(trace("labels"), frame).map(([x, y], i) => {
      const [block, isMarked] = [ids[i], ids[i] === marked.block];
      const text = `${block}${MARKS[statusOf(block)[0]] ?? ""}`;
      const r = (scale * ((isMarked ? 34 : 26) + 6 * Math.max(text.length - 2, 0))) / 2;
      const disc = svg("circle", { cx: x, cy: y, r, stroke: blocks.colors[block], "stroke-width": isMarked ? 4 : 2 });
      return svg("g", { class: "labels", "data-block": block }, disc, svg("text", { x, y: y + 4 }, text));
    });
  }

  /** The blocks of labels in the layer shown. @param {Trace} labels @returns {number[]} */
  const blocksOf = ({ customdata }) => {
    const { layer, stride } = figure?.blocks ?? { layer: 0, stride: 0 };
    return customdata.map((/** @type {number} */ block) => block - layer * stride + above);
  };

  /** The discs of cameras, or their rings. @param {Trace} cameras @param {Frame} frame */
  function discs({ name, marker, customdata, ...trace }, frame) {
    const size = ((narrow.matches ? 0.7 : 1) * marker.size) / 2;
    return placesOf({ name, ...trace }, frame).map(([cx, cy], i) => {
      const r = size * (name === "cameras" && customdata[i] === marked.row ? 1.9 : 1);
      return svg("circle", { class: name, cx, cy, r, fill: marker.color[i], "stroke-width": marker.line.width });
    });
  }

  /** @param {MapFigure} figure @param {Frame} frame */
  function content(figure, frame) {
    const named = (/** @type {string} */ start) => figure.data.filter(({ name }) => name.startsWith(start));
    const crosses = placesOf(trace("fixes"), frame).map(([x, y]) => `M${x - 4.5} ${y}h9M${x} ${y - 4.5}v9`);
    return [
      figure.blocks.planned && raster(trace("blocks"), cells, picture(figure), frame),
      raster(trace("points"), density, points, frame),
      ...["faces", "seams", "box"].flatMap(named).map((line) => polyline(line, frame)),
      crosses.length > 0 && svg("path", { class: "fixes", d: crosses.join("") }),
      ...named("cameras").flatMap((cameras) => discs(cameras, frame)),
      ...labels(figure, frame),
    ].filter((part) => part !== false);
  }

  function draw() {
    if (!figure || !plot.clientWidth || drag) return;
    above = Number(layerSelect.value) * figure.blocks.stride;
    const [width, height] = [plot.clientWidth, plot.clientHeight];
    frame = frameOf(zoomed ?? whole(figure), { width, height }, !narrow.matches);
    const { x, y, width: w, height: h } = frame;
    const moved = svg("g", {}, ...content(figure, frame));
    const inside = svg("svg", { class: "inside", x, y, width: w, height: h }, moved);
    plot.replaceChildren(svg("svg", { width, height }, inside, axes(frame, figure.layout)), tip);
    label();
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

  const key = () =>
    JSON.stringify([...statuses].map(([block, [status, share]]) => [block, status, Math.floor(share * 200)]));
  const soon = throttled(draw, PAUSE);

  /** @param {number} block */
  function describe(block) {
    const [status, share] = statusOf(block);
    return `block ${block}: ${status}${status === "done" || status === "kept" ? "" : ` ${percent(share)}`}`;
  }

  /** What is at a place of the window. @param {MouseEvent} event @returns {{camera?: number, block?: number, text?: string, at: [number, number]}} */
  function under({ clientX, clientY }) {
    const box = plot.getBoundingClientRect();
    const at = /** @type {[number, number]} */ ([clientX - box.x, clientY - box.y]);
    if (!figure || !frame) return { at };
    const [x, y] = [at[0] - frame.x, at[1] - frame.y];
    if (x < 0 || y < 0 || x > frame.width || y > frame.height) return { at };
    const away = placesOf(trace("cameras"), frame).map(([cx, cy]) => Math.hypot(cx - x, cy - y));
    const camera = away.reduce((best, distance, i) => (distance < (away[best] ?? NEAR) ? i : best), -1);
    if (camera >= 0) return { camera, at };
    const node = document.elementFromPoint(clientX, clientY)?.closest("[data-block], [data-text]");
    if (node instanceof SVGElement && node.dataset.text) return { text: node.dataset.text, at };
    if (!figure.blocks.planned) return { at };
    if (node instanceof SVGElement && plot.contains(node)) return { block: Number(node.dataset.block), at };
    const { x0, dx, y0, dy } = trace("blocks");
    const [column, row] = [(frame.left + x / frame.scale - x0) / dx, (frame.top - y / frame.scale - y0) / dy].map(
      Math.round,
    );
    const block = cells[row]?.[column];
    return block === undefined ? { at } : { block: block + above, at };
  }

  /** Shows what the pointer is on. @param {MouseEvent} event */
  function hover(event) {
    const { camera, block, text = "", at } = under(event);
    setText(byId("pointed"), block === undefined ? text : describe(block));
    tip.hidden = camera === undefined;
    if (camera === undefined) return;
    const trains = trace("cameras").text[camera];
    tip.replaceChildren(figure?.blocks.names[camera] ?? "", ...(trains ? [el("br"), trains] : []));
    const before = at[0] > plot.clientWidth / 2;
    tip.style.cssText = `top: ${at[1]}px; ${before ? `right: ${plot.clientWidth - at[0] + 12}px` : `left: ${at[0] + 12}px`}`;
  }

  /** Zooms by a factor, or to the whole map with 0. @param {number} factor */
  function zoom(factor) {
    if (!figure) return;
    const [left, right, bottom, top] = zoomed ?? whole(figure);
    const [x, y, across, up] = [left + right, bottom + top, right - left, top - bottom].map((sum) => sum / 2);
    zoomed = factor ? [x - across / factor, x + across / factor, y - up / factor, y + up / factor] : null;
    draw();
  }

  byId("zoom-in").addEventListener("click", () => zoom(STEP));
  byId("zoom-out").addEventListener("click", () => zoom(1 / STEP));
  byId("zoom-all").addEventListener("click", () => zoom(0));
  plot.addEventListener("dblclick", () => zoom(0));
  plot.addEventListener("click", (event) => {
    const { camera, block } = dragged ? {} : under(event);
    if (camera !== undefined) choose.camera(cameraRows()[camera]);
    else if (block !== undefined) choose.block(block);
  });
  plot.addEventListener("pointerleave", () => {
    tip.hidden = true;
    setText(byId("pointed"), "");
  });
  plot.addEventListener("pointerdown", ({ button, clientX, clientY, pointerId }) => {
    if (button !== 0 || coarse.matches) return;
    drag = { from: [clientX, clientY], by: [0, 0] };
    plot.setPointerCapture(pointerId);
  });
  plot.addEventListener("pointermove", (event) => {
    if (!drag) return hover(event);
    drag.by = [event.clientX - drag.from[0], event.clientY - drag.from[1]];
    plot.querySelector(".inside g")?.setAttribute("transform", `translate(${drag.by.join(" ")})`);
  });
  for (const end of ["pointerup", "pointercancel"])
    plot.addEventListener(end, () => {
      const [right, down] = drag?.by ?? [0, 0];
      drag = null;
      dragged = Math.hypot(right, down) > CLICK;
      if (!dragged || !figure || !frame) return;
      const [x, y] = [right / frame.scale, down / frame.scale];
      const [left, ...others] = zoomed ?? whole(figure);
      zoomed = [left - x, others[0] - x, others[1] + y, others[2] + y];
      draw();
    });
  layerSelect.addEventListener("change", draw);
  document.addEventListener("themechange", () => {
    points = figure ? shade(density) : "";
    draw();
  });
  // Also when the window stays as it is: a scroll bar that appears makes the card narrower.
  new ResizeObserver(draw).observe(plot);

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
      marked = { block, row };
      draw();
    },
    /** Rows and names of the cameras, for the keyboard. @returns {{row: number, name: string}[]} */
    cameras: () => cameraRows().map((row, i) => ({ row, name: figure?.blocks.names[i] ?? "" })),
  };
}
