// Distances between two points of the model.

import { at, press } from "./dom.js";
import { distance } from "./flight.js";
import { line, shape, visible } from "./overlay.js";

/** @typedef {import("./page.js").Point} Point */

const ROUNDS = 3; // of `Stage.pick`
const NEAR = 1e-3; // of a step: a line is cut there, because what is behind the view has no place in the picture

/** @param {number} length @param {number | null} metres  of a unit @returns {string} */
export function written(length, metres) {
  if (metres === null) return `${length.toPrecision(3)} units`;
  const value = length * metres;
  return `${value.toFixed(value < 10 ? 3 : value < 100 ? 2 : 1)} m`;
}

export class Measure {
  /** @param {import("./stage.js").Stage} stage @param {import("./flight.js").Flight} flight @param {number | null} metres  of a unit */
  constructor(stage, flight, metres) {
    this._stage = stage;
    this._flight = flight;
    this._metres = metres;
    /** @type {Point[]} one or two */
    this.points = [];
    this.active = false;
    this._busy = false;
    stage.onDrawn.push(() => this._draw());
    at("measure").addEventListener("click", () => this.toggle());
  }

  /** Begins or ends measuring. */
  toggle() {
    this.active = !this.active;
    press("measure", this.active);
    at("distance").hidden = !this.active;
    at("aim").hidden = !this.active;
    document.body.classList.toggle("measuring", this.active);
    if (!this.active) this.points = [];
    this._say(this.active ? "Click or tap two points." : "");
    this._draw();
  }

  /** @param {number} x @param {number} y  in CSS pixels. Takes the point there, the third one as a new first. */
  async take(x, y) {
    if (!this.active || this._busy) return;
    this._busy = true;
    try {
      const point = await this._stage.pick(x, y, ROUNDS);
      if (!this.active) return;
      if (!point) {
        this._say("There is nothing to measure: take a point of the model.");
        return;
      }
      this.points = this.points.length === 1 ? [this.points[0], point] : [point];
      if (this.points.length === 2) this._result();
      else this._say("Now the second point.");
      this._draw();
    } finally {
      this._busy = false;
    }
  }

  get _near() {
    return this._flight.step * NEAR;
  }

  /** The distance between the two points in world units, null before there are two. */
  get length() {
    return this.points.length === 2 ? distance(this.points[0], this.points[1]) : null;
  }

  _result() {
    const [a, b] = this.points;
    const strong = document.createElement("strong");
    strong.textContent = written(distance(a, b), this._metres);
    const height = written(Math.abs(a[1] - b[1]), this._metres),
      level = written(Math.hypot(a[0] - b[0], a[2] - b[2]), this._metres);
    at("measured").replaceChildren(strong, ` apart; ${level} along the ground, ${height} in height`);
  }

  /** @param {string} text */
  _say(text) {
    at("measured").textContent = text;
  }

  /** Draws points and line over the picture. */
  _draw() {
    const lines = at("lines"),
      labels = at("labels");
    if (!this.points.length) {
      if (lines.childElementCount) lines.replaceChildren();
      if (labels.childElementCount) labels.replaceChildren();
      return;
    }
    const places = this.points.map((point) => this._stage.project(point));
    const shapes = places
      .filter(({ ahead }) => ahead > this._near)
      .map(({ x, y }) => shape("circle", { cx: x, cy: y, r: 5 }));
    const [first, second] = this.points;
    const ends = second ? visible(this._stage, first, second, this._near) : null;
    labels.replaceChildren();
    if (ends) {
      const [from, to] = ends;
      shapes.unshift(line(ends));
      const label = document.createElement("p");
      label.textContent = written(/** @type {number} */ (this.length), this._metres);
      label.style.transform = `translate(calc(${((from.x + to.x) / 2).toFixed(1)}px - 50%), calc(${((from.y + to.y) / 2 - 22).toFixed(1)}px - 50%))`;
      labels.append(label);
    }
    lines.replaceChildren(...shapes);
  }
}
