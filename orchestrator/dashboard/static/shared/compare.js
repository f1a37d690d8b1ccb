// A render next to its ground truth: flat with a slider between the two, or as a 360° view. Also part of report.html.

import { panorama } from "../run/panorama.js";
import { el } from "./dom.js";

/**
 * A box for pictures that have the render above its ground truth.
 * @param {string} name what the slider compares, for screen readers
 */
export function comparison(name) {
  const split = el("input", { type: "range", min: 0, max: 100, value: 50, class: "split", "aria-label": `${name}: how much of the render is shown next to the ground truth` });
  const pictures = [el("img", { alt: "the ground truth" }), el("img", { alt: "the render" })];
  const render = pictures[1];
  const box = el("div", { class: "compare" },
    el("div", { class: "half truth" }, pictures[0]), el("div", { class: "half render" }, render),
    el("span", { class: "divider", "aria-hidden": "true" }),
    el("span", { class: "tag left", "aria-hidden": "true" }, "render"), el("span", { class: "tag right", "aria-hidden": "true" }, "ground truth"), split);
  /** Made when it is first wanted: a browser has few contexts of WebGL. @type {ReturnType<typeof panorama> | null} */
  let sphere = null;

  const cut = () => {
    box.style.setProperty("--split", `${split.value}%`);
    sphere?.split(Number(split.value) / 100);
  };
  split.addEventListener("input", cut);
  render.addEventListener("load", () => sphere?.load(render));

  return {
    box,
    /** @param {string} url of the picture, whose render has the aspect ratio 2 : 1 */
    show(url) {
      for (const image of pictures) if (image.getAttribute("src") !== url) image.src = url;
      sphere?.load(render);
      cut();
    },
    /** Shows the 360° view or the flat picture. Returns whether that is possible here. @param {boolean} on */
    around(on) {
      if (on && !sphere) {
        sphere = panorama(split);
        box.querySelector(".divider")?.before(sphere.canvas);
        sphere.load(render);
        cut();
      }
      if (on && !sphere?.possible) return false;
      box.classList.toggle("around", on);
      sphere?.show(on);
      if (on) sphere?.canvas.focus();
      return true;
    },
  };
}

/**
 * Lets two buttons choose between the flat picture and the 360° view.
 * @param {HTMLButtonElement} flat
 * @param {HTMLButtonElement} around
 * @param {ReturnType<typeof comparison>} compared
 */
export function projections(flat, around, compared) {
  /** @param {boolean} on */
  const project = (on) => {
    const possible = compared.around(on);
    if (!possible) Object.assign(around, { disabled: true, title: "this browser has no WebGL" });
    flat.setAttribute("aria-pressed", String(!(on && possible)));
    around.setAttribute("aria-pressed", String(on && possible));
  };
  flat.addEventListener("click", () => project(false));
  around.addEventListener("click", () => project(true));
}
