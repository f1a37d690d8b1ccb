// What is too faint or too large to be of a surface, as `panolog export --min-opacity --max-size` leaves it out.

import { at } from "./dom.js";

const PARTS = 1000; // of a slider
const FAINTEST = 0.9; // opacity at its end
const LARGEST = 20; // steps: the size at the end of the slider, from where on nothing is left out
const RANGE = 1000; // times as large as the size at its beginning

/** As the command line has it. @param {number} value */
const rounded = (value) => Number(value.toPrecision(4));

export class Floaters {
  /** @param {import("./stage.js").Stage} stage  with its model @param {number} step  world units */
  constructor(stage, step) {
    this._stage = stage;
    this._largest = LARGEST * step;
    /** Called after each change. */
    this.onChanged = () => {};
    this._faint = this._slider("fainter", 0);
    this._large = this._slider("larger", PARTS);
    this._changed();
  }

  /** For the command line, "" if nothing is left out. */
  get option() {
    const given = [this.opacity && `--min-opacity=${this.opacity}`, this.size && `--max-size=${this.size}`];
    return given.filter(Boolean).join(" ");
  }

  /** Shows all of the model again. */
  reset() {
    this._faint.value = "0";
    this._large.value = String(PARTS);
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

  _changed() {
    const part = Number(this._large.value) / PARTS;
    /** What is fainter is left out. */
    this.opacity = rounded((FAINTEST * Number(this._faint.value)) / PARTS);
    /** World units: that of which the longest standard deviation is more is left out; 0 for none. */
    this.size = part < 1 ? rounded(this._largest * RANGE ** (part - 1)) : 0;
    this._stage.limit(this.opacity, this.size);
    this.onChanged();
  }
}
