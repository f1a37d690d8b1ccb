// Mouse, fingers and keys.

/** @typedef {import("./flight.js").Flight} Flight @typedef {import("./page.js").Point} Point */

const TURN = 0.16; // degrees for a CSS pixel
const WHEEL = 0.0022; // of a step for a pixel of the wheel
const PINCH = 0.02; // of a step for a pixel between the fingers
const STILL = 6; // pixels within which a press is a click
const TWICE = 320; // ms within which two clicks are a double click
const SPIN = 70; // degrees per second by the arrows
const PACE = 2.2; // steps per second by the keys
const FASTER = 4;
/** @type {Record<string, Point>} right, up, ahead */
const KEYS = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyE: [0, 1, 0],
  KeyQ: [0, -1, 0],
  PageUp: [0, 1, 0],
  PageDown: [0, -1, 0],
};
/** @type {Record<string, [number, number]>} left, up */
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/**
 * @typedef {{
 *   click: (x: number, y: number) => void,
 *   twice: (x: number, y: number) => void,
 *   grab: () => void,
 * }} Calls  In CSS pixels of the canvas; `grab` is called when a drag begins.
 */

/** @param {HTMLCanvasElement} canvas @param {Flight} flight @param {Calls} calls */
export function listenToPointers(canvas, flight, calls) {
  /** @type {Map<number, { x: number, y: number, button: number }>} */
  const held = new Map();
  let far = false; // whether this press has become a drag
  let last = { time: 0, x: 0, y: 0 };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!held.size) far = false;
    else far = true; // two fingers never click
    held.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.shiftKey ? 2 : event.button });
    canvas.focus({ preventScroll: true });
    event.preventDefault();
  });
  canvas.addEventListener("pointermove", (event) => {
    const from = held.get(event.pointerId);
    if (!from) return;
    const dx = event.clientX - from.x,
      dy = event.clientY - from.y;
    if (!far && Math.hypot(dx, dy) < STILL) return;
    if (!far) calls.grab();
    far = true;
    const others = [...held].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    if (others.length) {
      const [other] = others;
      const apart =
        Math.hypot(event.clientX - other.x, event.clientY - other.y) - Math.hypot(from.x - other.x, from.y - other.y);
      const scale = flight.step * PINCH;
      flight.move([-dx * scale * 0.25, dy * scale * 0.25, apart * scale * 0.5]);
    } else if (from.button === 2 || from.button === 1) {
      const scale = flight.step * PINCH * 0.5;
      flight.move([-dx * scale, dy * scale, 0]);
    } else {
      const sign = flight.pivot ? -1 : 1;
      flight.turn(dx * TURN * sign * (flight.pivot ? 1.6 : 1), dy * TURN * sign * (flight.pivot ? 1.6 : 1));
    }
    held.set(event.pointerId, { ...from, x: event.clientX, y: event.clientY });
  });
  /** @param {PointerEvent} event */
  const release = (event) => {
    const from = held.get(event.pointerId);
    held.delete(event.pointerId);
    if (!from || far || event.type === "pointercancel" || from.button !== 0) return;
    const { left, top } = canvas.getBoundingClientRect();
    const x = event.clientX - left,
      y = event.clientY - top;
    const again = event.timeStamp - last.time < TWICE && Math.hypot(x - last.x, y - last.y) < 4 * STILL;
    last = { time: again ? 0 : event.timeStamp, x, y };
    if (again) calls.twice(x, y);
    else calls.click(x, y);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      calls.grab();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1);
      const scale = flight.pivot ? flight.pivot * 0.0012 : flight.step * WHEEL;
      flight.move([0, 0, -Math.max(-400, Math.min(400, pixels)) * scale]);
    },
    { passive: false },
  );
}

/**
 * @param {Flight} flight
 * @param {Record<string, (event: KeyboardEvent) => void>} commands  by `event.key` in lower case
 * @param {() => void} grab  called when a key begins to move the view
 */
export function listenToKeys(flight, commands, grab) {
  /** @type {Set<string>} */
  const down = new Set();
  let shift = false;

  const apply = () => {
    /** @type {Point} */
    const speed = [0, 0, 0];
    let left = 0,
      up = 0;
    const pace = PACE * (shift ? FASTER : 1);
    for (const code of down) {
      const by = KEYS[code],
        turn = ARROWS[code];
      if (by) for (const axis of /** @type {const} */ ([0, 1, 2])) speed[axis] += by[axis] * pace;
      if (turn) [left, up] = [left + turn[0], up + turn[1]];
    }
    flight.fly(speed);
    flight.spin(left * SPIN, up * SPIN);
  };

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const element = /** @type {HTMLElement} */ (event.target);
    const writes = element.matches("input[type=search], input[type=number]"),
      slides = element.matches("input[type=range]");
    if (event.key === "Escape" || !writes) {
      const command = commands[event.key.toLowerCase()];
      if (command && !event.repeat && !(event.key === "Enter" && element.matches("button, a"))) command(event);
    }
    const moves = event.code in KEYS || (event.code in ARROWS && !element.matches("section, section *"));
    if (writes || !moves || (slides && event.code in ARROWS)) return;
    event.preventDefault();
    shift = event.shiftKey;
    if (!down.has(event.code)) grab();
    down.add(event.code);
    apply();
  });
  document.addEventListener("keyup", (event) => {
    shift = event.shiftKey;
    down.delete(event.code);
    apply();
  });
  window.addEventListener("blur", () => {
    down.clear();
    apply();
  });
}
