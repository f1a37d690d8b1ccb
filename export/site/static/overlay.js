// Lines over the picture, in SVG.

import { between } from "./flight.js";

/** @typedef {import("./page.js").Point} Point */

const SVG = "http://www.w3.org/2000/svg";

/** @param {string} name @param {Record<string, number>} attributes */
export function shape(name, attributes) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value.toFixed(1));
  return element;
}

/**
 * The ends of a line in the picture, cut where it goes behind the view; null if all of it is there.
 * @param {import("./stage.js").Stage} stage @param {Point} a @param {Point} b @param {number} near  world units
 */
export function visible(stage, a, b, near) {
  const [from, to] = [stage.project(a).ahead, stage.project(b).ahead];
  if (from <= near && to <= near) return null;
  const cut = (near * 2 - from) / (to - from);
  if (from <= near) a = between(a, b, cut);
  if (to <= near) b = between(a, b, cut);
  return [stage.project(a), stage.project(b)];
}

/** @param {{ x: number, y: number }[]} ends  of a line, of two */
export const line = ([from, to]) => shape("line", { x1: from.x, y1: from.y, x2: to.x, y2: to.y });
