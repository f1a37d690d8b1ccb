// What is changed of the engine's shaders, and the field by which they know what is within a distance of the nearest camera.

import * as pc from "./engine.js";
import { around, into } from "./world.js";

/** @typedef {import("./page.js").Point} Point @typedef {import("./world.js").Box} Box */

const SIDE = 64; // cells of the field along each axis
const MIDDLE = 128; // what the field has at the distance; more is nearer
const SLOPE = 2; // cells within which it is neither 0 nor 255
const PAGE = /** @type {import("./page.js").Frame} */ ({
  rotation: [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ],
  origin: [0, 0, 0],
});

// Draws, in place of colours, by uDepths.w: 0 the colours; 1 in each channel what is nearer along the view than one of
// the depths; 2 of what is between the first two, where it is between them, and how much it is.
export const DEPTH = `
uniform vec4 uDepths;
void modifySplatColor(vec2 gaussianUV, inout vec4 color) {
  float depth = 1.0 / gl_FragCoord.w;
  if (uDepths.w == 1.0) color.rgb = step(vec3(depth), uDepths.xyz);
  if (uDepths.w == 2.0) {
    float place = (depth - uDepths.x) / (uDepths.y - uDepths.x);
    color.rgb = place >= 0.0 && place <= 1.0 ? vec3(place, 1.0, 0.0) : vec3(0.0);
  }
}
`;

// Leaves out what is not in [0, 1] by uKept, which is zero for all of the model; what is not there by uNear either, or has
// less than a half in the field uField; and by uLimits what is fainter than the first or larger than the second, which is
// zero for any size.
export const KEPT = `
uniform mat4 uKept;
uniform mat4 uNear;
uniform mediump sampler3D uField;
uniform vec2 uLimits;
float longest;
bool outside(vec3 place) { return any(lessThan(place, vec3(0.0))) || any(greaterThan(place, vec3(1.0))); }
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 original, vec3 center, inout vec4 rotation, inout vec3 scale) {
  longest = max(scale.x, max(scale.y, scale.z));
}
void modifySplatColor(vec3 center, inout vec4 color) {
  vec3 near = (uNear * vec4(center, 1.0)).xyz;
  if (outside((uKept * vec4(center, 1.0)).xyz) || outside(near) || textureLod(uField, near, 0.0).r < 0.5) color.a = 0.0;
  if (color.a < uLimits.x || (uLimits.y > 0.0 && longest > uLimits.y)) color.a = 0.0;
}
`;
export const ALL = new Float32Array(16);

/** @param {Point[]} points @param {number} distance @returns {{ box: Box, bytes: Uint8Array }} the field, x first */
function field(points, distance) {
  const whole = around(points);
  const lower = /** @type {Point} */ (whole.lower.map((value) => value - distance)),
    upper = /** @type {Point} */ (whole.upper.map((value) => value + distance));
  const size = lower.map((value, i) => (upper[i] - value) / SIDE),
    slope = SLOPE * Math.max(...size),
    far = distance + slope;
  const bytes = new Uint8Array(SIDE ** 3);
  /** @param {Point} point @param {number} axis  Cells along the axis that are near enough, and how far they are. */
  const cells = (point, axis) => {
    const place = point[axis] - lower[axis];
    const first = Math.max(0, Math.floor((place - far) / size[axis])),
      last = Math.min(SIDE - 1, Math.floor((place + far) / size[axis]));
    return Array.from({ length: last - first + 1 }, (_, i) => ({
      cell: first + i,
      square: ((first + i + 0.5) * size[axis] - place) ** 2,
    }));
  };
  for (const point of spread(points, lower, size)) {
    const [across, up, ahead] = [0, 1, 2].map((axis) => cells(point, axis));
    for (const z of ahead) {
      for (const y of up) {
        const row = SIDE * (y.cell + SIDE * z.cell),
          square = y.square + z.square;
        for (const x of across) {
          const value = MIDDLE + ((distance - Math.sqrt(square + x.square)) / slope) * MIDDLE;
          if (value > bytes[row + x.cell]) bytes[row + x.cell] = Math.min(255, value);
        }
      }
    }
  }
  return { box: { lower, upper }, bytes };
}

/** @param {Point[]} points @param {Point} lower @param {number[]} size  of a cell. @returns {Iterable<Point>} one of each cell */
function spread(points, lower, size) {
  const cell = (/** @type {Point} */ point) => point.map((value, i) => Math.floor((value - lower[i]) / size[i])).join();
  return new Map(points.map((point) => [cell(point), point])).values();
}

/** @param {pc.GraphicsDevice} device @param {number} side @param {Uint8Array} bytes  side³, x first. @returns {pc.Texture} */
export const volume = (device, side, bytes) =>
  new pc.Texture(device, {
    name: "field",
    width: side,
    height: side,
    depth: side,
    volume: true,
    format: pc.PIXELFORMAT_R8,
    levels: [bytes],
    mipmaps: false,
    minFilter: pc.FILTER_LINEAR,
    magFilter: pc.FILTER_LINEAR,
    addressU: pc.ADDRESS_CLAMP_TO_EDGE,
    addressV: pc.ADDRESS_CLAMP_TO_EDGE,
    addressW: pc.ADDRESS_CLAMP_TO_EDGE,
  });

export class Surroundings {
  /** @param {import("./stage.js").Stage} stage @param {Point[]} cameras  of the page */
  constructor(stage, cameras) {
    this._stage = stage;
    this._cameras = cameras;
    this._distance = 0;
    /** @type {pc.Texture | null} */
    this._shown = null;
  }

  /** @param {number} distance  world units, from the nearest camera, of what is shown; 0 for all */
  keep(distance) {
    if (distance === this._distance) return;
    this._distance = distance;
    const before = this._shown;
    if (distance) {
      const { box, bytes } = field(this._cameras, distance);
      this._shown = volume(this._stage.app.graphicsDevice, SIDE, bytes);
      this._stage.keepNear(into(box, PAGE), this._shown);
    } else {
      this._shown = null;
      this._stage.keepNear(ALL, this._stage.everywhere);
    }
    before?.destroy();
  }
}
