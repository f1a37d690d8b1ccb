// A path of the view, for `panolog render --poses`.

import { at, button, download, input } from "./dom.js";
import { ahead, distance, wrap } from "./flight.js";
import { placed, turned } from "./world.js";

/** @typedef {import("./page.js").Point} Point @typedef {import("./page.js").Pose} Pose */

const RATE = 30; // frames per second of a video of `panolog render`
const FULL_TURN = 20; // steps that take as long as a turn of 180 degrees
const DIGITS = 6;

/** @param {Pose} pose */
const values = ({ position, yaw, pitch }) => [...position, yaw, pitch];

/**
 * The pose at a time: cubic pieces through all keys, with continuous speed.
 * @param {number[][]} keys  as of `values`, angles unwrapped @param {number[]} times  ascending @param {number} time @returns {Pose}
 */
export function along(keys, times, time) {
  const last = keys.length - 1;
  const piece = Math.max(
    0,
    Math.min(
      last - 1,
      times.findLastIndex((begin) => begin <= time),
    ),
  );
  const [a, b] = [times[piece], times[piece + 1]];
  const t = Math.max(0, Math.min(1, (time - a) / (b - a)));
  /** @param {number} k @param {number} i  The speed of value i at key k. */
  const slope = (k, i) => {
    const [before, after] = [Math.max(0, k - 1), Math.min(last, k + 1)];
    return (keys[after][i] - keys[before][i]) / (times[after] - times[before]);
  };
  const [x, y, z, yaw, pitch] = keys[piece].map((from, i) => {
    const to = keys[piece + 1][i],
      length = b - a;
    return (
      (2 * t ** 3 - 3 * t ** 2 + 1) * from +
      (t ** 3 - 2 * t ** 2 + t) * length * slope(piece, i) +
      (3 * t ** 2 - 2 * t ** 3) * to +
      (t ** 3 - t ** 2) * length * slope(piece + 1, i)
    );
  });
  return { position: [x, y, z], yaw, pitch };
}

export class Path {
  /** @param {import("./flight.js").Flight} flight @param {import("./page.js").Frame} frame */
  constructor(flight, frame) {
    this._flight = flight;
    this._frame = frame;
    /** @type {Pose[]} */
    this.keys = [];
    /** Seconds since the begin of the path; null while it is not played. @type {number | null} */
    this.time = null;
    button("key").addEventListener("click", () => this._keep([...this.keys, flight.pose]));
    button("undo").addEventListener("click", () => this._keep(this.keys.slice(0, -1)));
    button("film").addEventListener("click", () => {
      const begins = this.time === null;
      for (const call of flight.onLeave) call(); // ends what else moves the view, and a path
      if (begins) this._play(0);
    });
    button("save-path").addEventListener("click", () =>
      download("path.json", JSON.stringify(this.frames()), "application/json"),
    );
    flight.onLeave.push(() => this._play(null));
    flight.onTurn.push(() => this._play(null));
    this._keep([]);
  }

  /** Of the whole path. */
  get seconds() {
    return Math.max(1, Math.min(600, Number(input("seconds").value) || 10));
  }

  /** @param {Pose[]} keys */
  _keep(keys) {
    this.keys = keys;
    this._play(null);
    const count = keys.length === 1 ? "1 view" : `${keys.length} views`;
    at("keys").textContent = keys.length < 2 ? `${count}; a path needs two` : count;
    button("undo").disabled = !keys.length;
    button("film").disabled = button("save-path").disabled = keys.length < 2;
  }

  /** @param {number | null} time */
  _play(time) {
    this.time = time;
    button("film").textContent = time === null ? "Play" : "Stop";
  }

  /** Keys with unwrapped angles, and when the view is there: by the way, and by turns. */
  _timed() {
    const keys = this.keys.map(values);
    for (let k = 1; k < keys.length; k++) keys[k][3] = keys[k - 1][3] + wrap(keys[k][3] - keys[k - 1][3]);
    const times = [0];
    for (let k = 1; k < keys.length; k++) {
      const turn = Math.hypot(keys[k][3] - keys[k - 1][3], keys[k][4] - keys[k - 1][4]) / 180;
      const way = distance(this.keys[k].position, this.keys[k - 1].position) / this._flight.step / FULL_TURN;
      times.push(times[k - 1] + Math.max(way + turn, 1e-3));
    }
    const scale = this.seconds / times[times.length - 1];
    return { keys, times: times.map((time) => time * scale) };
  }

  /** @param {number} seconds  since the last call */
  update(seconds) {
    if (this.time === null) return;
    const { keys, times } = this._timed();
    this.time = Math.min(this.seconds, this.time + seconds);
    this._flight.set(along(keys, times, this.time));
    if (this.time >= this.seconds) this._play(null);
  }

  /** The poses of all frames in the model's coordinates, as `panolog render --poses` reads them. */
  frames() {
    const { keys, times } = this._timed();
    const count = Math.max(2, Math.round(this.seconds * RATE));
    return Array.from({ length: count }, (_, number) => {
      const pose = along(keys, times, (number / (count - 1)) * this.seconds);
      const forward = ahead(pose.yaw, pose.pitch),
        down = ahead(pose.yaw, pose.pitch - 90),
        right = ahead(pose.yaw - 90, 0);
      const columns = [
        ...[right, down, forward].map((axis) => turned(this._frame, axis)),
        placed(this._frame, pose.position),
      ];
      return {
        name: `frame_${String(number).padStart(5, "0")}`,
        camera_to_world: [0, 1, 2].map((row) => columns.map((column) => Number(column[row].toFixed(DIGITS)))),
      };
    });
  }
}
