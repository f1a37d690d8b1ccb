// What of the model is shown, as `panolog export` takes it: a box, whose axes are those of the model, and what is neither
// too faint nor too large to be of a surface, nor too far from all cameras.

import { at } from "./dom.js";
import { shifted } from "./flight.js";
import { line, visible } from "./overlay.js";
import { Surroundings } from "./shaders.js";
import { around, corners, into, placed, shown } from "./world.js";

/** @typedef {import("./page.js").Point} Point @typedef {import("./world.js").Box} Box */

const MARGIN = 20; // steps around the cameras within which the box is moved
const PARTS = 1000; // of a slider
const NEAR = 0.1; // of a step: what is nearer is behind the view; lines far outside of the picture take long
const FAR = 1e9; // of a side that was not moved: it is no limit, as the page need not show all of the model
const FINE = 3; // digits of a side after those of a step
const FAINTEST = 0.9; // opacity at the end of its slider
const LARGEST = 20; // steps: size at the end of its slider, where nothing is left out
const SIZES = 1000; // times the size at its beginning
const FARTHEST = 200; // steps: distance at the end of its slider, likewise
const DISTANCES = 200; // times the distance at its beginning
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((from) =>
  [1, 2, 4].filter((bit) => !(from & bit)).map((bit) => /** @type {const} */ ([from, from | bit])),
);

/** @param {number} value  Of a side, for the command line. */
const written = (value) => (Math.abs(value) < FAR ? String(value) : value.toExponential());

/** As the command line has it. @param {number} value */
const rounded = (value) => Number(value.toPrecision(4));

export class Crop {
  /**
   * @param {import("./stage.js").Stage} stage  with its model @param {import("./page.js").Frame} frame
   * @param {Point[]} cameras  of the page @param {number} step  world units
   */
  constructor(stage, frame, cameras, step) {
    this._stage = stage;
    this._frame = frame;
    this._near = step * NEAR;
    this._digits = Math.max(0, FINE - Math.floor(Math.log10(step)));
    /** All of the model. */
    this.whole = around(corners(boxOf(stage.bounds)).map((corner) => placed(frame, corner)));
    /** Called after each change. */
    this.onChanged = () => {};
    this._reach = reach(this.whole, around(cameras.map((camera) => placed(frame, camera))), MARGIN * step);
    /** What is kept. @type {Box} */
    this.box = { lower: [-FAR, -FAR, -FAR], upper: [FAR, FAR, FAR] };
    this._sliders = ["lower", "upper"].flatMap((side) => [0, 1, 2].map((axis) => this._slider(side, axis)));
    stage.onDrawn.push(() => this._draw());
    this._show();
  }

  /** Whether something is left out. */
  get cuts() {
    const { lower, upper } = this.whole;
    return [0, 1, 2].some((i) => this.box.lower[i] > lower[i] || this.box.upper[i] < upper[i]);
  }

  /** For the command line, "" if nothing is left out. */
  get option() {
    if (!this.cuts) return "";
    return `--crop=${[...this.box.lower, ...this.box.upper].map(written).join(",")}`;
  }

  /** Shows all of the model again. */
  reset() {
    for (const { slider, side } of this._sliders) slider.value = side === "lower" ? slider.min : slider.max;
    this._changed();
  }

  /** @param {string} name @param {number} axis */
  _slider(name, axis) {
    const side = /** @type {"lower" | "upper"} */ (name);
    const slider = /** @type {HTMLInputElement} */ (at(`${side}-${"xyz"[axis]}`));
    slider.min = side === "lower" ? "0" : "1";
    slider.max = String(side === "lower" ? PARTS - 1 : PARTS);
    slider.value = side === "lower" ? slider.min : slider.max;
    slider.addEventListener("input", () => this._changed(side, axis));
    return { slider, side, axis };
  }

  /** @param {"lower" | "upper"} [side] @param {number} [axis]  Of the slider that was moved: the other one of its axis gives way. */
  _changed(side, axis) {
    for (const { slider, ...other } of this._sliders) {
      const twin = this._sliders.find((one) => one.axis === other.axis && one.side !== other.side);
      if (other.axis !== axis || other.side === side || !twin) continue;
      const least = Number(twin.slider.value) + (other.side === "upper" ? 1 : -1);
      slider.value = String(
        other.side === "upper" ? Math.max(least, Number(slider.value)) : Math.min(least, Number(slider.value)),
      );
    }
    for (const one of this._sliders) {
      const part = Number(one.slider.value) / PARTS,
        { lower, upper } = this._reach,
        value = lower[one.axis] + part * (upper[one.axis] - lower[one.axis]),
        end = one.side === "lower" ? part <= 0 : part >= 1;
      this.box[one.side][one.axis] = end ? (part ? FAR : -FAR) : Number(value.toFixed(this._digits));
    }
    this._show();
  }

  _show() {
    this._stage.keep(this.cuts ? into(this.box, this._frame) : null);
    this.onChanged();
  }

  /** Draws the edges of the box while something is left out. */
  _draw() {
    const edges = at("edges");
    if (!this.cuts) {
      if (edges.childElementCount) edges.replaceChildren();
      return;
    }
    const points = corners({
      lower: /** @type {Point} */ (this.box.lower.map((value, i) => Math.max(value, this._reach.lower[i]))),
      upper: /** @type {Point} */ (this.box.upper.map((value, i) => Math.min(value, this._reach.upper[i]))),
    }).map((corner) => shown(this._frame, corner));
    const ends = EDGES.map(([from, to]) => visible(this._stage, points[from], points[to], this._near));
    edges.replaceChildren(...ends.flatMap((one) => (one ? [line(one)] : [])));
  }
}

export class Floaters {
  /** @param {import("./stage.js").Stage} stage  with its model @param {Point[]} cameras  of the page @param {number} step  world units */
  constructor(stage, cameras, step) {
    this._stage = stage;
    this._step = step;
    this._surroundings = new Surroundings(stage, cameras);
    /** Called after each change. */
    this.onChanged = () => {};
    this._faint = this._slider("fainter", 0);
    this._large = this._slider("larger", PARTS);
    this._far = this._slider("farther", PARTS);
    at("far").hidden = !cameras.length;
    this._changed();
  }

  /** For the command line, "" if nothing is left out. */
  get option() {
    const given = { "min-opacity": this.opacity, "max-size": this.size, "max-distance": this.distance };
    return Object.entries(given)
      .flatMap(([name, value]) => (value ? `--${name}=${value}` : []))
      .join(" ");
  }

  /** Shows all of the model again. */
  reset() {
    this._faint.value = "0";
    this._large.value = this._far.value = String(PARTS);
    this._changed();
  }

  /** @param {string} name @param {number} value */
  _slider(name, value) {
    const slider = /** @type {HTMLInputElement} */ (at(name));
    slider.max = String(PARTS);
    slider.value = String(value);
    slider.addEventListener("input", () => this._changed());
    return slider;
  }

  /** @param {HTMLInputElement} slider @param {number} most  steps @param {number} range  World units; 0 at its end, for no limit. */
  _limit(slider, most, range) {
    const part = Number(slider.value) / PARTS;
    return part < 1 ? rounded(most * this._step * range ** (part - 1)) : 0;
  }

  _changed() {
    /** What is fainter is left out. */
    this.opacity = rounded((FAINTEST * Number(this._faint.value)) / PARTS);
    /** World units: that of which the longest standard deviation is more is left out; 0 for none. */
    this.size = this._limit(this._large, LARGEST, SIZES);
    /** World units: what is farther from all cameras is left out; 0 for none. */
    this.distance = this._limit(this._far, FARTHEST, DISTANCES);
    this._stage.limit(this.opacity, this.size);
    this._surroundings.keep(this.distance);
    this.onChanged();
  }
}

/** @param {{ middle: Point, half: Point }} bounds @returns {Box} */
const boxOf = ({ middle, half }) => ({ lower: shifted(middle, half, -1), upper: shifted(middle, half, 1) });

/** @param {Box} whole @param {Box} cameras  infinite without any @param {number} margin @returns {Box} in which the box is moved */
function reach(whole, cameras, margin) {
  /** @param {number} i */
  const room = (i) => Math.max(margin, (cameras.upper[i] - cameras.lower[i]) / 2);
  const any = Number.isFinite(cameras.lower[0]);
  return {
    lower: /** @type {Point} */ (
      whole.lower.map((value, i) => (any ? Math.max(value, cameras.lower[i] - room(i)) : value))
    ),
    upper: /** @type {Point} */ (
      whole.upper.map((value, i) => (any ? Math.min(value, cameras.upper[i] + room(i)) : value))
    ),
  };
}
