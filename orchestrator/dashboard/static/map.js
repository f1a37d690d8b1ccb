// The partition from above: cells by state and progress, points, cameras by the blocks that they serve.

import { get } from "./api.js";
import { byId, el, setText, throttled, token } from "./dom.js";
import { percent } from "./format.js";
import { draw, plotly, themed, unpack } from "./plot.js";
import { STANDINGS } from "./standings.js";

const STEP = 1.6; // of one zoom
const PAUSE = 900; // milliseconds between two drawings
const OPEN = 0.14; // opacity of the part of a cell that is still to do
const FULL = 0.42; // and of what is done
const MARK = 60; // of 255, what the chosen block is more opaque
const coarse = matchMedia("(pointer: coarse)"); // a finger on the map scrolls the page
const narrow = matchMedia("(max-width: 720px)");

const withAlpha = (color, alpha) => color.replace(/rgba?\(([^)]*)\)/, (_, parts) => `rgba(${parts.split(",").slice(0, 3)},${alpha})`);

/** For each standing the colour of its open and of its filled part, as [red, green, blue, alpha] bytes. */
function tints() {
  const tones = { kept: "waiting" };
  return STANDINGS.flatMap((standing) => {
    const tone = token(`--cell-${tones[standing] ?? standing}`).match(/[\d.]+/g).slice(0, 3).map(Number);
    return [[...tone, 255 * OPEN], [...tone, 255 * FULL]];
  });
}

/** For each pixel the share of its block's pixels in the rows below it: the block fills up to its progress. */
function levelsOf(rows) {
  const counts = new Map();
  const ranks = rows.map((row) => {
    const below = Float32Array.from(row, (block) => counts.get(block) ?? 0);
    for (const block of row) counts.set(block, (counts.get(block) ?? 0) + 1);
    return below;
  });
  ranks.forEach((row, i) => row.forEach((rank, j) => { row[j] = rank / counts.get(rows[i][j]); }));
  return ranks;
}

export function planMap(path, choose) {
  const plot = byId("map-plot");
  let figure = null; // what the server made
  let cells = null; // ids of the blocks of the layer shown, by pixel
  let levels = null;
  let standings = new Map();
  let wanted = ""; // what the figure is of
  let marked = { block: null, row: null };
  let drawn = "";

  const trace = (name) => figure?.data.find((item) => item.name === name);
  const cameras = () => figure.data.filter((item) => item.name.startsWith("cameras"));

  async function load() {
    try {
      figure = await get(`${path}/map`);
      for (const item of cameras()) item.meta = item.marker.size;
    } catch (error) {
      wanted = ""; // tried again with the next news
      byId("map-empty").textContent = error.message;
      return;
    }
    figure.base = { cells: unpack(trace("blocks").customdata), labels: [...(trace("labels")?.customdata ?? [])] };
    levels = levelsOf(figure.base.cells);
    const { layers, layer } = figure.blocks;
    byId("layer-label").hidden = layers < 2;
    byId("layer").replaceChildren(...Array.from({ length: layers }, (_, i) => el("option", { value: i }, `${i + 1} of ${layers}`)));
    byId("layer").value = layer;
    shift();
    byId("map-empty").hidden = true;
    byId("legend").hidden = false;
    choose.mapped(figure.blocks.colors);
    await render();
    for (const event of ["click", "hover", "unhover"]) plot.removeAllListeners?.(`plotly_${event}`);
    plot.on("plotly_click", click);
    plot.on("plotly_hover", point);
    plot.on("plotly_unhover", () => setText(byId("pointed"), ""));
  }

  /** The blocks of the chosen layer: those that came, moved up or down. */
  function shift() {
    const by = (Number(byId("layer").value) - figure.blocks.layer) * figure.blocks.stride;
    cells = figure.base.cells.map((row) => row.map((block) => block + by));
    const labels = trace("labels");
    labels.customdata = figure.base.labels.map((block) => block + by);
    labels.text = labels.customdata.map(String);
    labels.marker.line.color = labels.customdata.map((block) => figure.blocks.colors[block]);
  }

  /** The cells as a picture of their own: to draw it anew is cheap, however many cameras lie above it. */
  function picture() {
    const known = Array.from({ length: figure.blocks.count }, (_, block) => {
      const [standing, share] = standings.get(block) ?? ["waiting", 0];
      return { code: 2 * Math.max(STANDINGS.indexOf(standing), 0), share };
    });
    const [rows, columns] = [cells.length, cells[0].length];
    const canvas = Object.assign(document.createElement("canvas"), { width: columns, height: rows });
    const pen = canvas.getContext("2d");
    const image = pen.createImageData(columns, rows);
    const colors = tints();
    for (let i = 0; i < rows; i += 1) {
      for (let j = 0, at = 4 * (rows - 1 - i) * columns; j < columns; j += 1, at += 4) {
        const block = cells[i][j];
        const [red, green, blue, alpha] = colors[known[block].code + (levels[i][j] < known[block].share)];
        image.data[at] = red;
        image.data[at + 1] = green;
        image.data[at + 2] = blue;
        image.data[at + 3] = block === marked.block ? Math.min(alpha + MARK, 255) : alpha;
      }
    }
    pen.putImageData(image, 0, 0);
    return canvas.toDataURL();
  }

  /** The picture where its pixels belong. */
  function underlay() {
    const { x0, dx, y0, dy } = trace("blocks");
    const [rows, columns] = [cells.length, cells[0].length];
    return {
      source: picture(), xref: "x", yref: "y", layer: "below", sizing: "stretch",
      x: x0 - dx / 2, y: y0 + (rows - 0.5) * dy, sizex: columns * dx, sizey: rows * dy,
    };
  }

  /** How far all is, also for those who do not see it. */
  function tell() {
    drawn = key();
    const shares = [...standings.values()].map(([, share]) => share);
    const done = percent(shares.reduce((sum, share) => sum + share, 0) / Math.max(shares.length, 1));
    plot.setAttribute("aria-label", `The partition from above: ${shares.length} blocks, ${done} done`);
  }

  async function repaint() {
    if (!figure || !plot.layout) return;
    if (plot._dragging) return soon(); // plotly would let go of what somebody holds
    tell();
    const Plotly = await plotly();
    await Plotly.relayout(plot, { "images[0].source": picture() });
  }

  function dress() {
    const blocks = trace("blocks"); // only there to be pointed at
    blocks.colorscale = [[0, "rgba(0,0,0,0)"], [1, "rgba(0,0,0,0)"]];
    blocks.customdata = cells;
    blocks.hoverinfo = "none";
    delete blocks.hovertemplate;
    const ink = token("--points");
    trace("points").colorscale = [[0, withAlpha(ink, 0)], [0.02, withAlpha(ink, 0.3)], [1, withAlpha(ink, 0.95)]];
    const [surface, text, line] = [token("--surface"), token("--ink"), token("--line-strong")];
    for (const name of ["faces", "box"]) trace(name).line.color = line;
    for (const item of cameras()) item.marker.line.color = surface;
    const labels = trace("labels");
    labels.marker.color = surface;
    labels.textfont.color = text;
    const scale = narrow.matches ? 0.7 : 1;
    labels.textfont.size = narrow.matches ? 10 : 12;
    labels.marker.size = labels.customdata.map((block) => scale * (block === marked.block ? 34 : 26));
    labels.marker.line.width = labels.customdata.map((block) => (block === marked.block ? 4 : 2));
    for (const item of cameras()) {
      const size = scale * item.meta;
      item.marker.size = item.name === "cameras" ? item.customdata.map((row) => size * (row === marked.row ? 1.9 : 1)) : size;
    }
  }

  async function render() {
    if (!figure) return;
    dress();
    tell();
    const layout = themed(figure.layout);
    if (narrow.matches) for (const axis of [layout.xaxis, layout.yaxis]) axis.title = { text: "" };
    const data = figure.data.map((item) => ({ ...item }));
    await draw(plot, data, { ...layout, images: [underlay()], dragmode: coarse.matches ? false : "pan" });
  }

  const key = () => JSON.stringify([...standings].map(([block, [standing, share]]) => [block, standing, Math.floor(share * 200)]));
  const soon = throttled(repaint, PAUSE);

  function point({ points: [{ data, customdata }] }) {
    const [standing, share] = standings.get(Number(customdata)) ?? ["waiting", 0];
    const part = standing === "done" || standing === "kept" ? "" : ` ${percent(share)}`;
    setText(byId("pointed"), data.name === "blocks" || data.name === "labels" ? `block ${customdata}: ${standing}${part}` : "");
  }

  function click({ points: [point] }) {
    if (point.data.name.startsWith("cameras")) choose.camera(point.customdata);
    else choose.block(Number(point.customdata));
  }

  async function zoom(factor) {
    const Plotly = await plotly();
    const ranges = {};
    for (const axis of ["xaxis", "yaxis"]) {
      const [low, high] = factor ? plot.layout[axis].range : figure.layout[axis].range;
      const [middle, half] = [(low + high) / 2, (high - low) / 2 / (factor || 1)];
      ranges[`${axis}.range`] = [middle - half, middle + half];
    }
    await Plotly.relayout(plot, ranges);
  }

  byId("zoom-in").addEventListener("click", () => figure && zoom(STEP));
  byId("zoom-out").addEventListener("click", () => figure && zoom(1 / STEP));
  byId("zoom-all").addEventListener("click", () => figure && zoom(0));
  byId("layer").addEventListener("change", () => { shift(); render(); });
  document.addEventListener("themechange", () => render());
  byId("legend").append(...STANDINGS.filter((standing) => standing !== "kept").map((standing) => el("li", { "data-standing": standing }, standing)));

  return {
    update(run, now) {
      standings = now;
      const plan = run.summary.blocks.length ? JSON.stringify(run.summary.blocks) : "";
      if (plan && plan !== wanted) {
        wanted = plan;
        load();
      } else if (figure && key() !== drawn) soon();
    },
    mark(block, row = null) {
      const same = marked.row === row && trace("labels")?.customdata.length === 0;
      marked = { block, row };
      if (same) repaint();
      else render();
    },
    colors: () => figure?.blocks.colors ?? [],
    /** Rows and names of the cameras, for those who do not point. */
    cameras: () => (figure ? trace("cameras").customdata.map((row, i) => ({ row, name: figure.blocks.names[i] })) : []),
  };
}
