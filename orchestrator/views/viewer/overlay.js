// The panel over viser's canvas: what the page shows, and ways to look at it. viser's client is controlled by the same
// messages that its server would send; it shows its queue as a global.

/**
 * @typedef {[number, number, number]} Point
 * @typedef {{ name: string, position: Point, look_at: Point }} Camera  In the coordinates of the page.
 * @typedef {{ title: string, shown: number, total: number, sky: number, nodes: string[], cameras: Camera[] }} Page
 * @typedef {{
 *   messageQueue: object[],
 *   nodeRefFromName: Record<string, unknown>,
 *   cameraControl: unknown,
 *   requestRender: () => void,
 *   drainMessageQueue: (() => void) | null,
 *   resetCameraPose: ((animate: boolean) => void) | null,
 * }} Viewer  Of viser's client, what is used here.
 */

const LISTED = 200; // cameras at most; a search finds the others

/** @template {HTMLElement} [T=HTMLElement] @param {string} id @returns {T} */
const at = (id) => /** @type {T} */ (document.getElementById(`panolog-${id}`));

/** @type {Page} */
const page = JSON.parse(at("page").textContent ?? "");
const number = new Intl.NumberFormat("en");
/** @type {HTMLInputElement} */
const search = at("search");
/** @type {Camera | undefined} */
let current;

/** @param {(viewer: Viewer) => void} then  Called once viser has the scene. */
function whenShown(then) {
  const viewer = /** @type {{ __viserMutable?: Viewer }} */ (window).__viserMutable;
  if (viewer?.cameraControl && viewer.resetCameraPose && page.nodes.every((name) => viewer.nodeRefFromName[name])) {
    then(viewer);
  } else {
    requestAnimationFrame(() => whenShown(then));
  }
}

/** @param {Viewer} viewer @param {Camera} camera @param {boolean} initial  Whether it is where the view begins. */
function place(viewer, camera, initial) {
  const { position, look_at } = camera;
  viewer.messageQueue.push(
    { type: "SetCameraPositionMessage", position, initial },
    { type: "SetCameraLookAtMessage", look_at, initial },
  );
  viewer.requestRender();
}

/** @param {Viewer} viewer  Begins at the camera that the address names after #camera=. */
function beginAtCamera(viewer) {
  const name = new URLSearchParams(location.hash.slice(1)).get("camera");
  current = page.cameras.find((camera) => camera.name === name);
  if (!current) return;
  place(viewer, current, true);
  viewer.drainMessageQueue?.();
  viewer.resetCameraPose?.(false);
}

/** @param {Viewer} viewer @param {boolean} visible */
function showSky(viewer, visible) {
  at("sky").setAttribute("aria-pressed", String(visible));
  viewer.messageQueue.push({ type: "SetSceneNodeVisibilityMessage", name: "/sky", visible, owner: "" });
  viewer.requestRender();
}

/** @param {Viewer} viewer  Lists the cameras whose names contain what is searched. */
function listCameras(viewer) {
  const text = search.value.trim().toLowerCase();
  const found = page.cameras.filter((camera) => camera.name.toLowerCase().includes(text));
  at("names").replaceChildren(
    ...found.slice(0, LISTED).map((camera) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = camera.name;
      if (camera === current) button.ariaCurrent = "true";
      button.addEventListener("click", () => {
        at("names").querySelector("[aria-current]")?.removeAttribute("aria-current");
        button.ariaCurrent = "true";
        current = camera;
        place(viewer, camera, false);
        if (matchMedia("(max-width: 600px)").matches) close(); // it covers the view
      });
      const item = document.createElement("li");
      item.append(button);
      return item;
    }),
  );
  const many = found.length > LISTED;
  at("found").textContent = found.length
    ? many ? `the first ${LISTED} of ${number.format(found.length)}` : ""
    : "no camera has such a name";
}

/** @param {string} opener @param {string} section  Opens or closes a section, and closes the other one. */
function toggle(opener, section) {
  const open = at(section).hidden;
  for (const [button, part] of [["list", "cameras"], ["how", "help"]]) {
    at(part).hidden = !(open && part === section);
    at(button).ariaExpanded = String(open && button === opener);
  }
  return open;
}

/** @param {KeyboardEvent} event  Up and down go through the list, and do not turn the view meanwhile. */
function moveInList(event) {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (!step) return;
  const buttons = [.../** @type {NodeListOf<HTMLElement>} */ (at("names").querySelectorAll("button"))];
  const next = buttons.indexOf(/** @type {HTMLElement} */ (document.activeElement)) + step;
  (next < 0 ? search : buttons[Math.min(next, buttons.length - 1)])?.focus();
  event.preventDefault();
  event.stopPropagation();
}

/** Closes what is open, and gives its button the focus. */
function close() {
  for (const [button, part] of [["list", "cameras"], ["how", "help"]]) {
    if (at(part).hidden) continue;
    toggle(button, part);
    at(button).focus();
  }
}

/** @param {Viewer} viewer */
function offer(viewer) {
  beginAtCamera(viewer);
  const start = current;
  at("home").addEventListener("click", () => {
    viewer.resetCameraPose?.(true);
    current = start;
    listCameras(viewer);
  });
  at("sky").addEventListener("click", () => showSky(viewer, at("sky").ariaPressed !== "true"));
  at("list").addEventListener("click", () => {
    if (!toggle("list", "cameras")) return;
    listCameras(viewer);
    at("names").querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  });
  search.addEventListener("input", () => listCameras(viewer));
  at("cameras").addEventListener("keydown", moveInList);
  for (const id of ["home", "sky", "list"]) at(id).removeAttribute("disabled");
}

const part = page.shown < page.total ? `${number.format(page.shown)} of ${number.format(page.total)}` : number.format(page.shown);
at("count").textContent = `${part} Gaussians${page.sky ? `, ${number.format(page.sky)} of them sky` : ""}`;
/** @type {HTMLElement} */ (document.querySelector("#panolog h1")).textContent = page.title;
at("sky").hidden = !page.sky;
at("list").hidden = !page.cameras.length;
at("how").addEventListener("click", () => toggle("how", "help"));
document.addEventListener("keydown", (event) => event.key === "Escape" && close());
whenShown(offer);

export {};
