// Numbers for people. What is not known is a dash.

const NONE = "–";
const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

export const fixed = (value, digits = 2) => (known(value) ? value.toFixed(digits) : NONE);
export const count = (value) => (known(value) ? Math.round(value).toLocaleString("en-US") : NONE);
export const percent = (share) => (known(share) ? `${Math.floor(share * 100)}%` : NONE);
export const decibel = (value) => (known(value) ? `${value.toFixed(2)} dB` : NONE);
export const significant = (value) => (known(value) ? String(Number(value.toPrecision(4))) : NONE);

/** 1,234,567 → 1.23 M */
export function short(value) {
  if (!known(value)) return NONE;
  for (const [size, unit] of [[1e9, "G"], [1e6, "M"], [1e4, "k"]]) {
    if (value >= size) return `${Number((value / (unit === "k" ? 1e3 : size)).toPrecision(3))} ${unit}`;
  }
  return count(value);
}

export function bytes(value) {
  if (!known(value)) return NONE;
  for (const [size, unit] of [[2 ** 30, "GiB"], [2 ** 20, "MiB"], [2 ** 10, "KiB"]]) {
    if (value >= size) return `${Number((value / size).toPrecision(3))} ${unit}`;
  }
  return `${value} B`;
}

/** Seconds as 45 s, 12 min 5 s, 3 h 20 min, 2 d 4 h. */
export function duration(seconds) {
  if (!known(seconds)) return NONE;
  const s = Math.max(Math.round(seconds), 0);
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
}

/** How long ago, from seconds since the epoch. */
export function ago(time) {
  if (!known(time)) return NONE;
  const s = Math.max(Date.now() / 1000 - time, 0);
  if (s < 5) return "now";
  const [size, unit] = s < 60 ? [1, "s"] : s < 3600 ? [60, "min"] : s < 86400 ? [3600, "h"] : [86400, "d"];
  return `${Math.floor(s / size)} ${unit} ago`;
}

export function clock(time) {
  const date = new Date(time * 1000);
  const day = date.toDateString() === new Date().toDateString() ? "" : `${date.toLocaleDateString("en-CA")} `;
  return day + date.toLocaleTimeString("en-GB");
}

/** "block/003" → "Block 3", "coarse" → "Stage I". */
export function taskLabel(task) {
  const [kind, number] = task.split("/");
  const names = { coarse: "Stage I", score: "Scoring", block: "Block", plan: "Partition", merge: "Merge", eval: "Evaluation" };
  const name = names[kind] ?? (kind ? kind[0].toUpperCase() + kind.slice(1) : "Run");
  return number === undefined ? name : `${name} ${Number(number)}`;
}

export const blockTask = (block) => `block/${String(block).padStart(3, "0")}`;
export const blockOf = (task) => (task.startsWith("block/") ? Number(task.slice(6)) : null);
