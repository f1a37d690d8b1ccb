// The coordinates of the model, in which `panolog export --crop` and `panolog render --poses` take places.

/** @typedef {import("./page.js").Point} Point @typedef {import("./page.js").Frame} Frame */

/** @type {number[]} */
const AXES = [0, 1, 2];

/** @param {Frame} frame @param {Point} direction  of the page. @returns {Point} in the model's coordinates */
export const turned = ({ rotation }, direction) =>
  /** @type {Point} */ (AXES.map((i) => AXES.reduce((sum, j) => sum + rotation[j][i] * direction[j], 0)));

/** @param {Frame} frame @param {Point} point  of the page. @returns {Point} in the model's coordinates */
export const placed = (frame, point) =>
  /** @type {Point} */ (turned(frame, point).map((value, i) => value + frame.origin[i]));

/** @param {Frame} frame @param {Point} point  in the model's coordinates. @returns {Point} of the page */
export const shown = ({ rotation, origin }, point) =>
  /** @type {Point} */ (AXES.map((j) => AXES.reduce((sum, i) => sum + rotation[j][i] * (point[i] - origin[i]), 0)));

/** @typedef {{ lower: Point, upper: Point }} Box */

/** @param {Point[]} points @returns {Box} around them */
export const around = (points) => ({
  lower: /** @type {Point} */ (AXES.map((i) => Math.min(...points.map((point) => point[i])))),
  upper: /** @type {Point} */ (AXES.map((i) => Math.max(...points.map((point) => point[i])))),
});

/** @param {Box} box @returns {Point[]} its eight corners: bit i of the number says which side of axis i */
export const corners = ({ lower, upper }) =>
  [0, 1, 2, 3, 4, 5, 6, 7].map(
    (number) => /** @type {Point} */ (AXES.map((i) => (number & (1 << i) ? upper : lower)[i])),
  );

/** @param {Box} box @param {Frame} frame  The matrix by which the page's points are in [0, 1] inside. */
export function into(box, { rotation, origin }) {
  const matrix = new Float32Array(16);
  matrix[15] = 1;
  for (const i of [0, 1, 2]) {
    const length = box.upper[i] - box.lower[i];
    for (const j of [0, 1, 2]) matrix[4 * j + i] = rotation[j][i] / length;
    matrix[12 + i] = (origin[i] - box.lower[i]) / length;
  }
  return matrix;
}
