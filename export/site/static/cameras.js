// The list of cameras with its search.

import { at, close, input, number, toggle } from "./dom.js";

/** @typedef {import("./page.js").Camera} Camera */

const LISTED = 200; // cameras at most; a search finds the others

/** @param {import("./walk.js").Walk} walk */
export function offerCameras(walk) {
  const list = () => show(walk);
  at("list").addEventListener("click", () => {
    if (!toggle("cameras")) return;
    list();
    at("names").querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  });
  input("search").addEventListener("input", list);
  at("cameras").addEventListener("keydown", moveInList);
  walk.onChange.push(() => !at("cameras").hidden && mark(walk.current));
}

/** @param {import("./walk.js").Walk} walk  Lists the cameras whose names contain what is searched. */
function show(walk) {
  const text = input("search").value.trim().toLowerCase();
  const found = walk.cameras.filter((camera) => camera.name.toLowerCase().includes(text));
  at("names").replaceChildren(
    ...found.slice(0, LISTED).map((camera) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = camera.name;
      button.addEventListener("click", () => {
        walk.go(camera);
        if (matchMedia("(max-width: 600px)").matches) close(); // it covers the view
      });
      const item = document.createElement("li");
      item.append(button);
      return item;
    }),
  );
  mark(walk.current);
  const many = found.length > LISTED;
  at("found").textContent = found.length
    ? many
      ? `the first ${LISTED} of ${number.format(found.length)}`
      : ""
    : "no camera has such a name";
}

/** @param {Camera | null} current */
function mark(current) {
  for (const button of at("names").querySelectorAll("button")) {
    if (current && button.textContent === current.name) button.ariaCurrent = "true";
    else button.removeAttribute("aria-current");
  }
}

/** @param {KeyboardEvent} event  Up and down go through the list, and do not turn the view meanwhile. */
function moveInList(event) {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (!step) return;
  const buttons = [.../** @type {NodeListOf<HTMLElement>} */ (at("names").querySelectorAll("button"))];
  const next = buttons.indexOf(/** @type {HTMLElement} */ (document.activeElement)) + step;
  (next < 0 ? input("search") : buttons[Math.min(next, buttons.length - 1)])?.focus();
  event.preventDefault();
  event.stopPropagation();
}
