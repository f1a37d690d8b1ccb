// What is made of the view: a picture, the whole screen, what an export keeps, and a camera path.

import { Crop, Floaters } from "./crop.js";
import { at, button, copy, download, press } from "./dom.js";
import { Path } from "./path.js";

/** @typedef {import("./page.js").Page} Page @typedef {import("./stage.js").Stage} Stage */

/** @param {Stage} stage @param {string} title  Saves what is drawn: right after it is drawn, as the browser keeps no picture. */
function savePicture(stage, title) {
  stage.onDrawn.push(function save() {
    stage.onDrawn.splice(stage.onDrawn.indexOf(save), 1);
    stage.canvas.toBlob((picture) => picture && download(`${title}.png`, picture, "image/png"));
  });
  stage.draw();
}

function offerFullScreen() {
  const full = button("full");
  full.hidden = !document.fullscreenEnabled;
  full.addEventListener("click", () =>
    document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen(),
  );
  document.addEventListener("fullscreenchange", () => press("full", document.fullscreenElement !== null));
}

/** Shows with which options an export keeps what is shown. @param {(Crop | Floaters)[]} parts */
function offerOption(parts) {
  const show = () => {
    const option = parts.flatMap((part) => part.option || []).join(" ");
    at("option").textContent = option;
    at("kept").hidden = !option;
    button("copy").disabled = button("whole").disabled = !option;
  };
  for (const part of parts) part.onChanged = show;
  button("whole").addEventListener("click", () => parts.forEach((part) => part.reset()));
  button("copy").addEventListener("click", () => copy(at("option")));
  show();
}

/**
 * @param {Stage} stage  with its model @param {import("./flight.js").Flight} flight @param {Page} page
 * @returns {{ crop: Crop, floaters: Floaters, path: Path } | null}  null where the coordinates of the model are not known
 */
export function offerTools(stage, flight, page) {
  button("picture").addEventListener("click", () => savePicture(stage, page.title));
  offerFullScreen();
  at("edit").hidden = !page.frame;
  if (!page.frame) return null;
  const cameras = page.cameras.map(({ position }) => position);
  const crop = new Crop(stage, page.frame, cameras, flight.step),
    floaters = new Floaters(stage, cameras, flight.step);
  offerOption([crop, floaters]);
  return { crop, floaters, path: new Path(flight, page.frame) };
}
