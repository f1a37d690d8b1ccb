// The walk along the cameras: play, a slider, one camera at a time; and the photograph of the camera where the view is.

import { at, button, input, press, pressed, still } from "./dom.js";
import { between, distance } from "./flight.js";

/** @typedef {import("./page.js").Camera} Camera @typedef {import("./page.js").Point} Point @typedef {import("./page.js").Pose} Pose */

const PACE = 0.75; // cameras per second
const GAP = 6; // times the usual distance: what lies between is flown over quickly
const FADE = 0.5; // s
const TRAVEL = 0.9; // s to a camera
const PAUSE = 1.6; // s at each camera for who wants no movement

/** @param {Camera[]} cameras  The usual distance between one and the next, 0 if there is none. */
export function spacing(cameras) {
  const steps = cameras
    .slice(1)
    .map((camera, i) => distance(camera.position, cameras[i].position))
    .filter((step) => step > 0);
  return steps.sort((a, b) => a - b)[steps.length >> 1] ?? 0;
}

/** @param {Camera[]} cameras @param {Point} position  The number of the nearest one. */
function nearest(cameras, position) {
  let best = 0,
    least = Infinity;
  cameras.forEach((camera, i) => {
    const away = distance(camera.position, position);
    if (away < least) [best, least] = [i, away];
  });
  return best;
}

/** @param {Point} a @param {Point} b @param {Point} c @param {Point} d @param {number} t @returns {Point} Catmull-Rom from b to c */
function spline(a, b, c, d, t) {
  /** @param {0 | 1 | 2} i */
  const axis = (i) =>
    0.5 *
    (2 * b[i] +
      t * (c[i] - a[i] + t * (2 * a[i] - 5 * b[i] + 4 * c[i] - d[i] + t * (3 * (b[i] - c[i]) + d[i] - a[i]))));
  return [axis(0), axis(1), axis(2)];
}

export class Walk {
  /**
   * @param {import("./stage.js").Stage} stage @param {import("./flight.js").Flight} flight @param {Camera[]} cameras
   * @param {import("./panorama.js").Panorama} picture  in front of the model
   */
  constructor(stage, flight, cameras, picture) {
    this._stage = stage;
    this._flight = flight;
    this.cameras = cameras;
    this._picture = picture;
    this._usual = spacing(cameras) || 1;
    /** Cameras from the first: a whole number at a camera. */
    this.place = nearest(cameras, flight.position);
    this.plays = false;
    this._waited = 0;
    /** The camera where the view is. @type {Camera | null} */
    this.current = null;
    /** Called when `current` has changed. @type {(() => void)[]} */
    this.onChange = [];
    /** The camera whose photograph is loaded. @type {Camera | null} */
    this._arrived = null;
    /** How far the user has turned to the left and up while the walk plays, in degrees. @type {[number, number]} */
    this._turned = [0, 0];
    flight.onLeave.push(() => this.leave());
    flight.onTurn.push((left, up) => {
      if (this.plays) this._turned = [this._turned[0] + left, this._turned[1] + up];
    });
    if (cameras.length) this._connect();
  }

  _connect() {
    at("walk").hidden = false;
    at("photo").hidden = !this.cameras.some((camera) => camera.photograph);
    input("along").max = String(this.cameras.length - 1);
    button("play").addEventListener("click", () => this.toggle());
    button("play").disabled = this.cameras.length < 2;
    if (button("play").disabled) button("play").title = "A walk needs two cameras, and there is one";
    button("back").addEventListener("click", () => this.step(-1));
    button("on").addEventListener("click", () => this.step(1));
    input("along").addEventListener("input", () => {
      this.leave();
      this.place = Number(input("along").value);
      this._flight.set(this._pose());
      this._say();
    });
    input("along").addEventListener("change", () => {
      const near = Math.round(this.place);
      if (Math.abs(near - this.place) < 0.02) this.go(this.cameras[near]);
    });
    button("photograph").addEventListener("click", () => {
      press("photograph", !pressed("photograph"));
      if (pressed("photograph") && this.current) this._show();
      else if (pressed("photograph")) this.go(this.cameras[nearest(this.cameras, this._flight.position)]);
    });
    input("strength").addEventListener("input", () => {
      if (!pressed("photograph")) button("photograph").click();
    });
    this._say();
  }

  /** Plays or pauses. */
  toggle() {
    if (this.plays) {
      this.pause();
      return;
    }
    if (this.cameras.length < 2) return;
    this.plays = true;
    this._waited = 0;
    this._turned = [0, 0];
    this._leave();
    press("photograph", false);
    if (this.place >= this.cameras.length - 1) this.place = 0;
    this._mark();
    this._flight.travel(this._pose(), still.matches ? 0 : 0.6);
  }

  /** Stops the walk where it is. */
  pause() {
    this.plays = false;
    this._mark();
  }

  _mark() {
    at("play").classList.toggle("playing", this.plays);
    at("play").setAttribute("aria-label", this.plays ? "Pause the walk" : "Play the walk");
  }

  /** @param {number} by  Goes to the next camera or the one before. */
  step(by) {
    const from = by > 0 ? Math.floor(this.place + 1e-6) : Math.ceil(this.place - 1e-6);
    const camera = this.cameras[Math.max(0, Math.min(this.cameras.length - 1, from + by))];
    if (camera) this.go(camera);
  }

  /**
   * Goes there, and shows its photograph if that is on; at once, the model.
   * @param {Camera} camera @param {boolean} [atOnce]
   */
  go(camera, atOnce = false) {
    this.pause();
    this._leave();
    this.place = this.cameras.indexOf(camera);
    this._set(camera);
    this._say();
    history.replaceState(null, "", `#camera=${encodeURIComponent(camera.name)}`);
    this._flight.pivot = 0;
    press("orbit", false);
    this._flight.travel(camera, atOnce || still.matches ? 0 : TRAVEL, () => atOnce || this._show());
  }

  /** The user moves the view away: what is shown there is the model. */
  leave() {
    this.pause();
    this._leave();
    press("photograph", false);
  }

  _leave() {
    this._picture.forget();
    this._arrived = null;
    if (this.current) this._set(null);
  }

  /** @param {Camera | null} camera */
  _set(camera) {
    this.current = camera;
    for (const call of this.onChange) call();
  }

  async _show() {
    const camera = this.current;
    if (!camera?.photograph || !camera.rotation || !pressed("photograph")) return;
    if (this._arrived === camera) return;
    try {
      if (await this._picture.show(camera.photograph, camera.rotation)) this._arrived = camera;
    } catch {
      at("where").textContent = `${camera.name}: its photograph cannot be loaded`;
    }
  }

  /** @returns {Pose} the pose on the path at `place`, looking along it */
  _pose() {
    const { cameras, place } = this,
      i = Math.min(cameras.length - 1, Math.floor(place)),
      t = place - i;
    if (t < 1e-6) return cameras[i];
    /** @param {number} k */
    const point = (k) => cameras[Math.max(0, Math.min(cameras.length - 1, k))].position;
    const far = distance(point(i), point(i + 1)) > GAP * this._usual;
    const curve = (/** @type {number} */ s) =>
      far ? between(point(i), point(i + 1), s) : spline(point(i - 1), point(i), point(i + 1), point(i + 2), s);
    const from = cameras[i],
      to = cameras[Math.min(i + 1, cameras.length - 1)];
    const turn = ((((to.yaw - from.yaw + 180) % 360) + 360) % 360) - 180;
    return { position: curve(t), yaw: from.yaw + t * turn, pitch: from.pitch + t * (to.pitch - from.pitch) };
  }

  /** @param {number} seconds  since the last picture */
  update(seconds) {
    this._fade(seconds);
    if (!this.plays || this._flight.travels) return;
    const last = this.cameras.length - 1;
    if (still.matches) {
      this._waited += seconds;
      if (this._waited < PAUSE) return;
      this._waited = 0;
      this.place = Math.min(last, Math.floor(this.place) + 1);
    } else {
      const i = Math.min(last - 1, Math.floor(this.place));
      const apart = distance(this.cameras[i].position, this.cameras[i + 1].position) / this._usual;
      const pace = PACE / Math.max(0.4, Math.min(3, apart));
      this.place = Math.min(last, this.place + Math.min(seconds, 0.25) * pace);
    }
    this._flight.set(this._keptTurn(this._pose()));
    this._say();
    if (this.place >= last) this.pause();
  }

  /** @param {Pose} pose  The same, looking where the user has turned to since the walk began. */
  _keptTurn(pose) {
    return { position: pose.position, yaw: pose.yaw + this._turned[0], pitch: pose.pitch + this._turned[1] };
  }

  /** @param {number} seconds */
  _fade(seconds) {
    const there = this._arrived !== null && this._arrived === this.current && pressed("photograph");
    const wanted = there ? Number(input("strength").value) / 100 : 0,
      { opacity } = this._picture;
    at("tag").hidden = opacity === 0;
    if (opacity === wanted) return;
    const by = still.matches ? 1 : seconds / FADE;
    this._picture.setOpacity(opacity < wanted ? Math.min(wanted, opacity + by) : Math.max(wanted, opacity - by));
  }

  _say() {
    const { cameras } = this,
      near = Math.round(this.place);
    input("along").value = String(this.place);
    input("along").setAttribute("aria-valuetext", cameras[near].name);
    at("where").textContent = `${near + 1} / ${cameras.length} · ${cameras[near].name}`;
  }
}
