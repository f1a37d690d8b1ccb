// The page of a model: what it shows, and ways to look at it.

import { offerCameras } from "./cameras.js";
import { at, button, close, number, press, say, still, toggle } from "./dom.js";
import { ahead, angles, between, distance, Flight, shifted } from "./flight.js";
import { listenToKeys, listenToPointers } from "./input.js";
import { Measure } from "./measure.js";
import { Panorama } from "./panorama.js";
import { makeStage, StageError } from "./stage.js";
import { offerTools } from "./tools.js";
import { spacing, Walk } from "./walk.js";

/** @typedef {import("./page.js").Page} Page @typedef {import("./page.js").Pose} Pose */

const START = /** @type {Pose} */ ({ position: [0, 0, 0], yaw: 0, pitch: 0 });
const NEARER = 0.7; // of the way to a point that is double-clicked

/** @returns {Promise<{ page: Page, contents: ArrayBuffer | null }>} what is to be shown, from this file or next to it */
async function read() {
  const inside = document.getElementById("scene");
  if (!inside) {
    const answer = await fetch("scene.json");
    if (!answer.ok) throw new StageError(`scene.json cannot be loaded: ${answer.status}`);
    return { page: await answer.json(), contents: null };
  }
  const text = document.getElementById("model")?.textContent ?? "";
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return { page: JSON.parse(inside.textContent ?? ""), contents: bytes.buffer };
}

/** @param {Page} page  Says how large the model is, and how far its training. */
function tell(page) {
  const part =
    page.shown < page.total
      ? `${number.format(page.shown)} of ${number.format(page.total)}`
      : number.format(page.total);
  let iteration = page.iteration ? ` · iteration ${number.format(page.iteration)}` : ""; // not of older pages
  if (page.iteration === 0) iteration = " · before training";
  at("count").textContent = page.total ? `${part} Gaussians${iteration}` : "";
}

/** @param {Page} page */
function describe(page) {
  document.title = page.title;
  at("title").textContent = page.title;
  tell(page);
  at("list").hidden = !page.cameras.length;
  at("sky").hidden = !page.sky;
}

/** @param {import("./stage.js").Stage} stage @param {Flight} flight @param {number} x @param {number} y  Goes to the point there. */
async function approach(stage, flight, x, y) {
  const point = await stage.pick(x, y);
  if (!point) return;
  const position = between(flight.position, point, NEARER);
  const [x0, y0, z0] = flight.position,
    [x1, y1, z1] = point;
  const look = angles([x1 - x0, y1 - y0, z1 - z0]);
  for (const call of flight.onLeave) call();
  flight.travel({ position, ...look }, still.matches ? 0 : 0.8);
}

/** @param {import("./stage.js").Stage} stage @param {Flight} flight  Turns around the point in front, or no longer. */
async function toggleOrbit(stage, flight) {
  if (flight.pivot) {
    flight.pivot = 0;
  } else {
    const { clientWidth, clientHeight } = stage.canvas;
    const point = await stage.pick(clientWidth / 2, clientHeight / 2);
    flight.pivot = point ? distance(point, flight.position) : 5 * flight.step;
  }
  press("orbit", flight.pivot > 0);
}

/** @param {Page} page @param {Walk} walk @param {Flight} flight  Where the view begins, or the camera that the address names. */
function begin(page, walk, flight) {
  const name = new URLSearchParams(location.hash.slice(1)).get("camera");
  const camera = page.cameras.find((one) => one.name === name);
  if (camera) walk.go(camera, true);
  else if (name !== null) at("where").textContent = `there is no camera ${name}`;
  return () => {
    walk.leave();
    flight.pivot = 0;
    press("orbit", false);
    if (camera) walk.go(camera);
    else flight.travel(page.start ?? page.cameras[0] ?? START, still.matches ? 0 : 0.9);
  };
}

/** @param {Page} page @param {string} url  The URL with what distinguishes a later model. */
const fresh = (page, url) => `${url}?${page.iteration ?? "done"}-${page.total}`;

/**
 * Looks for newer models of a training, and shows each in place of the last: the view stays where it is.
 * @param {import("./stage.js").Stage} stage @param {Page} page @param {Panorama | undefined} sky
 */
async function follow(stage, page, sky) {
  let now = page;
  while (now.refresh) {
    await new Promise((resolve) => setTimeout(resolve, 1000 * (now.refresh ?? 0)));
    if (document.hidden) continue;
    try {
      const answer = await fetch("scene.json");
      if (!answer.ok) continue;
      /** @type {Page} */
      const next = await answer.json();
      if (fresh(next, "") !== fresh(now, "")) {
        await stage.replace(fresh(next, next.model));
        if (next.sky) await sky?.show(fresh(next, next.sky));
        tell(next);
      }
      now = next;
    } catch {
      // the server is busy or away, or the files were replaced meanwhile: tried again
    }
  }
}

/** @param {import("./stage.js").Stage} stage @param {Page} page  The button of the sky, which comes when it is loaded. */
async function showSky(stage, page) {
  if (!page.sky) return;
  const sky = new Panorama(stage.app, "behind");
  stage.backdrops.push(sky.entity);
  at("sky").addEventListener("click", () => {
    const visible = sky.opacity === 0;
    press("sky", visible);
    sky.setOpacity(visible ? 1 : 0);
  });
  try {
    await sky.show(page.sky);
    button("sky").disabled = false;
    return sky;
  } catch {
    at("sky").hidden = true; // the model can be seen without
  }
}

/** @param {{ middle: import("./page.js").Point, radius: number }} bounds @returns {Pose}  From above and outside. */
function outside({ middle, radius }) {
  const away = /** @type {const} */ ([0.5, 0.35, 0.5]);
  const position = /** @type {import("./page.js").Point} */ (middle.map((value, axis) => value + radius * away[axis]));
  return { position, ...angles([-away[0], -away[1], -away[2]]) };
}

async function show() {
  const { page, contents } = await read();
  describe(page);
  at("how").addEventListener("click", () => toggle("help") && at("help").focus());
  at("more").addEventListener("click", () => toggle("extras") && at("extras").focus());
  const canvas = /** @type {HTMLCanvasElement} */ (at("view"));
  const stage = await makeStage(canvas);
  const flight = new Flight(page.start ?? page.cameras[0] ?? START, page.step ?? (spacing(page.cameras) || 1));
  const picture = new Panorama(stage.app, "before");
  stage.backdrops.push(picture.entity);
  const walk = new Walk(stage, flight, page.cameras, picture);
  const measure = new Measure(stage, flight, page.metres_per_unit);
  const home = begin(page, walk, flight);

  const orbit = () => toggleOrbit(stage, flight);
  const middle = () => measure.take(canvas.clientWidth / 2, canvas.clientHeight / 2);
  const grab = () => walk.plays && flight.travels && flight.halt();
  button("home").addEventListener("click", home);
  button("orbit").addEventListener("click", orbit);
  offerCameras(walk);
  listenToPointers(canvas, flight, {
    click: (x, y) => measure.take(x, y),
    twice: (x, y) => (measure.active ? measure.take(x, y) : approach(stage, flight, x, y)),
    grab,
  });
  listenToKeys(
    flight,
    {
      escape: () => close() || (measure.active && measure.toggle()) || flight.halt(),
      h: () => button("how").click(),
      "?": () => button("how").click(),
      p: () => walk.toggle(),
      ",": () => walk.step(-1),
      ".": () => walk.step(1),
      m: () => measure.toggle(),
      o: orbit,
      0: home,
      enter: middle,
    },
    grab,
  );

  let last = performance.now();
  stage.app.on("update", () => {
    const now = performance.now(),
      seconds = (now - last) / 1000;
    last = now;
    walk.update(seconds);
    tools?.path.update(seconds);
    if (flight.update(seconds)) stage.follow(flight);
    const more = ready && stage.loading ? " · loading details" : "";
    if (at("loading").textContent !== more) at("loading").textContent = more;
  });
  window.addEventListener("hashchange", () => {
    const name = new URLSearchParams(location.hash.slice(1)).get("camera");
    const camera = page.cameras.find((one) => one.name === name);
    if (camera && camera !== walk.current) walk.go(camera);
  });

  let ready = false;
  /** @type {ReturnType<typeof offerTools>} */
  let tools = null;
  const progress = /** @type {HTMLProgressElement} */ (at("progress"));
  const sky = showSky(stage, page);
  await stage.load(
    page.model,
    contents,
    (share) => {
      progress.hidden = false;
      progress.value = share;
    },
    () => {
      if (page.step === null && !page.cameras.length) flight.step = stage.bounds.radius / 20;
      stage.setStep(flight.step);
      if (page.start || page.cameras.length) return;
      page.start = outside(stage.bounds);
      flight.set(page.start);
      stage.follow(flight);
    },
  );
  progress.hidden = true;
  ready = true;
  say("");
  tools = offerTools(stage, flight, page);
  for (const id of ["home", "list", "measure", "orbit", "more"]) button(id).disabled = false;
  performance.mark("first picture");
  Object.assign(window, { panolog: { stage, flight, walk, measure, tools, ahead, shifted } });
  document.documentElement.dataset.state = "ready";
  const backdrop = await sky;
  stage.draw();
  await follow(stage, page, backdrop);
}

at("offline").remove();
show().catch((error) => {
  document.documentElement.dataset.state = "failed";
  at("progress").hidden = true;
  say(error instanceof StageError ? error.message : `The model cannot be shown: ${error?.message ?? error}`, true);
  if (!(error instanceof StageError)) console.error(error);
});
