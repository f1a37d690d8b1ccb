// Numbers as text. An unknown number is a dash.

/** @typedef {number | null | undefined} Maybe */

const NONE = "–";

/** @param {(value: number) => string} format @returns {(value: Maybe) => string} */
const orDash = (format) => (value) =>
  value !== null && value !== undefined && Number.isFinite(value) ? format(value) : NONE;

/** @param {Maybe} value */
export const fixed = (value, digits = 2) => orDash((known) => known.toFixed(digits))(value);
export const count = orDash((value) => Math.round(value).toLocaleString("en-US"));
/** @param {number} iteration  Of a picture: when it was rendered. */
export const moment = (iteration) => (iteration ? `iteration ${count(iteration)}` : "before training");
export const percent = orDash((share) => `${Math.floor(share * 100)}%`);
export const decibel = orDash((value) => `${value.toFixed(2)} dB`);
export const significant = orDash((value) => String(Number(value.toPrecision(4))));

/** 1,234,567 → 1.23 M */
export const short = orDash((value) => {
  const [size, unit] = value >= 1e9 ? [1e9, "G"] : value >= 1e6 ? [1e6, "M"] : [1e3, "k"];
  return value < 1e4 ? count(value) : `${Number((value / size).toPrecision(3))} ${unit}`;
});

export const bytes = orDash((value) => {
  const [size, unit] = value >= 2 ** 30 ? [2 ** 30, "GiB"] : value >= 2 ** 20 ? [2 ** 20, "MiB"] : [2 ** 10, "KiB"];
  return value < 2 ** 10 ? `${value} B` : `${Number((value / size).toPrecision(3))} ${unit}`;
});

/** Seconds as 45 s, 12 min 5 s, 3 h 20 min, 2 d 4 h. */
export const duration = orDash((seconds) => {
  const s = Math.max(Math.round(seconds), 0);
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
});

/** The time since a moment in seconds since the epoch. */
export const ago = orDash((time) => {
  const s = Math.max(Date.now() / 1000 - time, 0);
  if (s < 5) return "now";
  const [size, unit] = s < 60 ? [1, "s"] : s < 3600 ? [60, "min"] : s < 86400 ? [3600, "h"] : [86400, "d"];
  return `${Math.floor(s / size)} ${unit} ago`;
});

/** A time, with the date if that is another day. @param {number} time seconds since the epoch @param {number} other the same, by default now */
export function clock(time, other = Date.now() / 1000) {
  const [date, known] = [time, other].map((seconds) => new Date(seconds * 1000));
  const day = date.toDateString() === known.toDateString() ? "" : `${date.toLocaleDateString("en-CA")} `;
  return day + date.toLocaleTimeString("en-GB");
}

/** Words as a sentence. @param {string} text */
export const sentence = (text) => `${text.charAt(0).toUpperCase()}${text.slice(1)}.`;

/** A path or another text as a word of a shell command. @param {string} text */
export const shellWord = (text) => (/^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** The metrics in their order, with how they are shown. @type {{key: string, label: string, unit: string, digits: number, lower: boolean}[]} */
export const METRICS = [
  { key: "ws_psnr", label: "WS-PSNR", unit: "dB", digits: 2, lower: false },
  { key: "psnr", label: "PSNR", unit: "dB", digits: 2, lower: false },
  { key: "ssim", label: "SSIM", unit: "", digits: 4, lower: false },
  { key: "ws_ssim", label: "WS-SSIM", unit: "", digits: 4, lower: false },
  { key: "lpips", label: "LPIPS", unit: "less is better", digits: 4, lower: true },
];

/** @type {Record<string, string>} */
const TASKS = {
  prepare: "preparation",
  district: "district",
  coarse: "Stage I",
  score: "scoring",
  plan: "partition",
  block: "block",
  union: "union",
  round: "second round of block",
  repair: "repair of seam",
  merge: "merge",
  measure: "measurement",
  eval: "evaluation",
  deliver: "delivery",
  calibrate: "calibration",
};

/** A task as people read it: "Stage I", "block 3", "scoring 0", "merge"; "run" for "". @param {string} task */
export function taskLabel(task) {
  const [kind, number] = task.split("/");
  const name = TASKS[kind] ?? (kind || "run");
  return number === undefined ? name : `${name} ${Number(number)}`;
}

/** @param {number} block */
export const blockTask = (block) => `block/${String(block).padStart(3, "0")}`;
