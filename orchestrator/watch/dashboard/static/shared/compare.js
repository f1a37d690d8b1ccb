// Two pictures of a panorama, such as a render and its ground truth: flat with a slider between the two, or as a 360° view.

import { el } from "panolog/shared/dom.js";
import { panorama } from "panolog/shared/panorama.js";

/** A part of a picture: the ground truth at its bottom, or the render at its top. @typedef {{url: string, truth: boolean, label: string}} Side */

/** The two sides of one picture. @param {string} url @returns {[Side, Side]} */
const sidesOf = (url) => [
  { url, truth: false, label: "render" },
  { url, truth: true, label: "ground truth" },
];

const JOINED = 4096; // pixels of a joined picture at most

/** Both sides in one picture, the left one above the right one. @param {HTMLImageElement[]} images @param {Side[]} sides */
function joined(images, sides) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = Math.min(JOINED, Math.max(...images.map((image) => image.naturalWidth)));
  const half = canvas.height / 2;
  images.forEach((image, i) => {
    const [width, height] = [image.naturalWidth, image.naturalWidth / 2];
    canvas
      .getContext("2d")
      ?.drawImage(
        image,
        0,
        sides[i].truth ? image.naturalHeight - height : 0,
        width,
        height,
        0,
        i * half,
        canvas.width,
        half,
      );
  });
  return canvas;
}

/**
 * A box for pictures that have the render above its ground truth.
 * @param {string} name what the slider compares, for screen readers
 */
export function comparison(name) {
  const split = el("input", { type: "range", min: 0, max: 100, value: 50, class: "split", "aria-label": name });
  const [render, truth] = [el("img", { alt: "" }), el("img", { alt: "" })];
  const halves = [el("div", { class: "half render" }, render), el("div", { class: "half truth" }, truth)];
  const tags = ["left", "right"].map((side) => el("span", { class: `tag ${side}`, "aria-hidden": "true" }));
  const box = el(
    "div",
    { class: "compare" },
    halves[1],
    halves[0],
    el("span", { class: "divider", "aria-hidden": "true" }),
    tags,
    split,
  );
  let sides = sidesOf("");
  /** Made when it is first wanted: a browser has few contexts of WebGL. @type {ReturnType<typeof panorama> | null} */
  let sphere = null;

  const cut = () => {
    box.style.setProperty("--split", `${split.value}%`);
    sphere?.split(Number(split.value) / 100);
  };
  const load = () => {
    if (!sphere || !render.naturalWidth || !truth.naturalWidth) return;
    const [left, right] = sides;
    const whole = left.url === right.url && !left.truth && right.truth; // the picture is as the sphere takes it
    sphere.load(whole ? render : joined([render, truth], sides));
  };
  /** @param {Side} left @param {Side} right */
  const pair = (left, right) => {
    sides = [left, right];
    split.setAttribute("aria-label", `${name}: how much of the ${left.label} is shown next to the ${right.label}`);
    [render, truth].forEach((image, i) => {
      const side = sides[i];
      halves[i].classList.toggle("bottom", side.truth);
      tags[i].textContent = side.label;
      image.alt = `the ${side.label}`;
      if (image.getAttribute("src") !== side.url) image.src = side.url;
    });
    load();
    cut();
  };
  split.addEventListener("input", cut);
  for (const image of [render, truth]) image.addEventListener("load", load);

  return {
    box,
    /** Shows two parts of pictures; a picture of the aspect ratio 2 : 1 has one part alone. */
    pair,
    /** @param {string} url of the picture, whose render has the aspect ratio 2 : 1 */
    show: (url) => pair(...sidesOf(url)),
    /** Shows the 360° view or the flat picture. Returns whether that is possible here. @param {boolean} on */
    around(on) {
      if (on && !sphere) {
        sphere = panorama(split);
        box.querySelector(".divider")?.before(sphere.canvas);
        load();
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
