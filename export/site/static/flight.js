// Where the view is, and how it moves. No engine: numbers in, numbers out.

/** @typedef {import("./page.js").Pose} Pose @typedef {import("./page.js").Point} Point */

const RADIANS = Math.PI / 180;
const STEEP = 89; // degrees of pitch at most
const EASE = 9; // 1/s: how soon a key takes full effect
const LONGEST = 0.1; // s of a frame that keys move for: a slow frame is no leap

/** @param {number} degrees  The same angle within ±180. */
export const wrap = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;

/** @param {number} t in [0, 1]; slow at both ends */
const smooth = (t) => t * t * (3 - 2 * t);

/** @param {number} yaw @param {number} pitch degrees @returns {Point} the unit vector ahead */
export function ahead(yaw, pitch) {
  const level = Math.cos(pitch * RADIANS);
  return [-Math.sin(yaw * RADIANS) * level, Math.sin(pitch * RADIANS), -Math.cos(yaw * RADIANS) * level];
}

/** @param {Point} direction @returns {{ yaw: number, pitch: number }} degrees */
export function angles([x, y, z]) {
  return { yaw: Math.atan2(-x, -z) / RADIANS, pitch: Math.atan2(y, Math.hypot(x, z)) / RADIANS };
}

/** @param {Point} a @param {Point} b @param {number} [t] @returns {Point} a + t (b - a) */
export const between = (a, b, t = 1) => [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])];

/** @param {Point} a @param {Point} b */
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

/** @param {Point} point @param {Point} direction @param {number} by @returns {Point} */
export const shifted = (point, direction, by) => [
  point[0] + by * direction[0],
  point[1] + by * direction[1],
  point[2] + by * direction[2],
];

export class Flight {
  /** @param {Pose} pose @param {number} step  World units that are a step here: the sense of scale. */
  constructor(pose, step) {
    this.step = step;
    /** @type {Point} */
    this.position = [...pose.position];
    this.yaw = pose.yaw;
    this.pitch = pose.pitch;
    /** Distance of the point that the view turns around; 0: it turns around itself. */
    this.pivot = 0;
    /** Called when the user moves the view, not when it is only turned. @type {(() => void)[]} */
    this.onLeave = [];
    /** Called with degrees to the left and up when the user turns the view. @type {((left: number, up: number) => void)[]} */
    this.onTurn = [];
    /** @type {Point} right, up, ahead: what the keys ask for, in steps per second */
    this._wanted = [0, 0, 0];
    /** @type {Point} */
    this._speed = [0, 0, 0];
    /** Degrees per second to the left and up. @type {[number, number]} */
    this._turning = [0, 0];
    /** @type {{ from: Pose, to: Pose, time: number, seconds: number, done: () => void } | null} */
    this._journey = null;
    this._changed = true;
  }

  /** @returns {Pose} */
  get pose() {
    return { position: [...this.position], yaw: this.yaw, pitch: this.pitch };
  }

  /** @param {Pose} pose */
  set(pose) {
    this._journey = null;
    this._place(pose);
  }

  /** @param {Pose} pose */
  _place({ position, yaw, pitch }) {
    this.position = [...position];
    this.yaw = wrap(yaw);
    this.pitch = Math.max(-STEEP, Math.min(STEEP, pitch));
    this._changed = true;
  }

  /** @param {Pose} to @param {number} seconds @param {() => void} [done]  Goes there; at once in 0 seconds. */
  travel(to, seconds, done = () => {}) {
    this.halt();
    if (!(seconds > 0)) {
      this.set(to);
      done();
      return;
    }
    this._journey = { from: this.pose, to, time: 0, seconds, done };
  }

  /** Whether it is on its way somewhere. */
  get travels() {
    return this._journey !== null;
  }

  /** Stops what moves the view. */
  halt() {
    this._journey = null;
    this._speed = [0, 0, 0];
  }

  /** @param {number} left @param {number} up degrees */
  turn(left, up) {
    if (!left && !up) return;
    const centre = shifted(this.position, ahead(this.yaw, this.pitch), this.pivot);
    const cut = this._journey !== null; // on its way it has left, and has arrived nowhere
    this._journey = null;
    this._place({ position: this.position, yaw: this.yaw + left, pitch: this.pitch + up });
    if (cut) for (const call of this.onLeave) call();
    if (!this.pivot) {
      for (const call of this.onTurn) call(left, up);
      return;
    }
    this.position = shifted(centre, ahead(this.yaw, this.pitch), -this.pivot);
    for (const call of this.onLeave) call();
  }

  /** @param {Point} by  right, up, ahead: in world units */
  move([right, up, forward]) {
    if (!right && !up && !forward) return;
    this._journey = null;
    let { position } = this;
    position = shifted(position, [Math.cos(this.yaw * RADIANS), 0, -Math.sin(this.yaw * RADIANS)], right);
    position = shifted(position, ahead(this.yaw, this.pitch + 90), up);
    if (this.pivot) {
      const left = Math.max(this.step * 0.02, this.pivot - forward);
      forward = this.pivot - left;
      this.pivot = left;
    }
    this.position = shifted(position, ahead(this.yaw, this.pitch), forward);
    this._changed = true;
    for (const call of this.onLeave) call();
  }

  /** @param {Point} speed  steps per second to the right, up and ahead, until it is called again */
  fly(speed) {
    this._wanted = speed;
  }

  /** @param {number} left @param {number} up  degrees per second, until it is called again */
  spin(left, up) {
    this._turning = [left, up];
  }

  /** @param {number} seconds  since the last call. Returns whether the view has changed. */
  update(seconds) {
    const journey = this._journey;
    if (journey) {
      journey.time += seconds;
      const t = Math.min(1, journey.time / journey.seconds),
        share = smooth(t);
      this._place({
        position: between(journey.from.position, journey.to.position, share),
        yaw: journey.from.yaw + share * wrap(journey.to.yaw - journey.from.yaw),
        pitch: journey.from.pitch + share * (journey.to.pitch - journey.from.pitch),
      });
      if (t === 1) {
        this._journey = null;
        journey.done();
      }
    }
    const short = Math.min(seconds, LONGEST);
    const [left, up] = this._turning;
    this.turn(left * short, up * short);
    const ease = 1 - Math.exp(-EASE * short);
    this._speed = between(this._speed, this._wanted, ease);
    if (Math.hypot(...this._speed) < 0.01) this._speed = [0, 0, 0];
    const by = short * this.step;
    this.move([this._speed[0] * by, this._speed[1] * by, this._speed[2] * by]);
    const changed = this._changed;
    this._changed = false;
    return changed;
  }
}
