// The figure of a plan as SVG, at the size that it has on the page, so that marks and letters keep theirs in any zoom.

/** @import { MapFigure, Packed, Trace } from "./figure.js" */
import { svg } from "panolog/shared/dom.js";

/** A part of the place in world units, and where it is on the page in pixels. @typedef {ReturnType<typeof frameOf>} Frame */
/** [left, right, bottom, top] in world units. @typedef {[number, number, number, number]} Window */

const LETTER = 6.5; // pixels of a digit
const TICKS = 40; // pixels between two numbers of an axis at least
const ARRAYS = { u1: Uint8Array, i1: Int8Array, i2: Int16Array, i4: Int32Array };

/** A packed array as its rows. @param {Packed} packed */
export function unpack({ dtype, bdata, shape }) {
  const [rows, columns] = shape.split(",").map(Number);
  const text = atob(bdata);
  const raw = new Uint8Array(text.length);
  for (let i = 0; i < raw.length; i += 1) raw[i] = text.charCodeAt(i);
  const flat = new ARRAYS[dtype](raw.buffer);
  return Array.from({ length: rows }, (_, i) => flat.subarray(i * columns, (i + 1) * columns));
}

/** A colour as one number of a picture's buffer. @param {number[]} color red, green, blue, alpha in bytes */
export const pixel = (color) => new Uint32Array(Uint8ClampedArray.from(color).buffer)[0];

/** A raster as the URL of a picture. @param {ArrayLike<number>[]} rows lowest first @param {(value: number, row: number, column: number) => number} color as `pixel` */
export function painted(rows, color) {
  const [height, width] = [rows.length, rows[0].length];
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { willReadFrequently: true }));
  const image = context.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  for (const [i, row] of rows.entries())
    for (let j = 0; j < width; j += 1) pixels[(height - 1 - i) * width + j] = color(row[j], i, j);
  context.putImageData(image, 0, 0);
  return canvas.toDataURL();
}

/** The round numbers between two, about so many. @param {number} low @param {number} high @param {number} wanted */
function ticks(low, high, wanted) {
  const least = (high - low) / Math.max(wanted, 1);
  const power = 10 ** Math.floor(Math.log10(least));
  const step = power * (least > 5 * power ? 10 : least > 2 * power ? 5 : least > power ? 2 : 1);
  const begin = Math.ceil(low / step);
  const digits = Math.max(-Math.floor(Math.log10(step)), 0);
  return Array.from({ length: Math.floor(high / step) - begin + 1 }, (_, i) => {
    const value = (begin + i) * step;
    return { value, text: value.toFixed(digits).replace("-", "−") };
  });
}

/** Where a window is on the page: as large as there is room, x and y to the same scale. @param {Window} window @param {{width: number, height: number}} room pixels @param {boolean} titled */
export function frameOf([left, right, bottom, top], room, titled) {
  const rows = ticks(bottom, top, room.height / TICKS);
  const margin = {
    left: (titled ? 26 : 8) + LETTER * Math.max(...rows.map(({ text }) => text.length), 2),
    below: titled ? 40 : 22,
  };
  const [width, height] = [room.width - margin.left - 14, room.height - margin.below - 6].map((size) =>
    Math.max(size, 1),
  );
  const scale = Math.min(width / (right - left), height / (top - bottom));
  const size = { width: scale * (right - left), height: scale * (top - bottom) };
  const corner = { x: margin.left + (width - size.width) / 2, y: 6 + (height - size.height) / 2 };
  const columns = ticks(left, right, size.width / TICKS);
  /** @param {number} x world units */
  const across = (x) => (x - left) * scale;
  /** @param {number} y world units */
  const down = (y) => (top - y) * scale;
  return { ...corner, ...size, scale, left, top, titled, rows, columns, across, down };
}

/** A raster of a figure. @param {Trace} trace @param {ArrayLike<number>[]} rows @param {string} href @param {Frame} frame */
export function raster({ name, x0, dx, y0, dy }, rows, href, { across, down, scale }) {
  const [width, height] = [rows[0].length * dx, rows.length * dy];
  const [x, y] = [across(x0 - dx / 2), down(y0 - dy / 2 + height)];
  const size = { x, y, width: width * scale, height: height * scale };
  return svg("image", { class: name, href, ...size, preserveAspectRatio: "none" });
}

/** A line with gaps. @param {Trace} trace @param {Frame} frame */
export function polyline({ name, x, y, line, text }, { across, down }) {
  const path = x.map((/** @type {number | null} */ value, /** @type {number} */ i) =>
    value === null
      ? ""
      : `${i === 0 || x[i - 1] === null ? "M" : "L"}${across(value).toFixed(1)} ${down(y[i]).toFixed(1)}`,
  );
  return svg("path", { class: name, d: path.join(""), "data-text": text, style: text && `stroke: ${line.color}` });
}

/** Where the marks of a trace are, in pixels of the frame. @param {Trace} trace @param {Frame} frame @returns {[number, number][]} */
export const placesOf = ({ x = [], y = [] }, { across, down }) =>
  x.map((/** @type {number} */ value, /** @type {number} */ i) => [across(value), down(y[i])]);

/** The numbers of the axes, and what they count. @param {Frame} frame @param {MapFigure["layout"]} layout */
export function axes({ x, y, width, height, titled, rows, columns, across, down }, { xaxis, yaxis }) {
  const below = columns.map(({ value, text }) => svg("text", { x: x + across(value), y: y + height + 15 }, text));
  const left = rows.map(({ value, text }) => svg("text", { class: "row", x: x - 5, y: y + down(value) + 4 }, text));
  const names = [
    svg("text", { x: x + width / 2, y: y + height + 34 }, xaxis.title.text),
    svg("text", { transform: `translate(13 ${y + height / 2}) rotate(-90)` }, yaxis.title.text),
  ];
  return svg("g", { class: "axes" }, ...below, ...left, ...(titled ? names : []));
}
