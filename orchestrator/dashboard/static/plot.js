// plotly, loaded when it is first needed, in the colours of the page.

import { token } from "./dom.js";

const CONFIG = { displayModeBar: false, responsive: true, doubleClick: "reset", showTips: false };
// plotly brings the style of its geographic maps as an inline sheet, which the policy of these pages refuses.
// It leaves out what is there already, by this id; there are no geographic maps here.
const GEOGRAPHIC = "9f215cf04c5486422605d13261cb87401f4e7763b6296af81e98efbc0130da53";
let loading = null;

export function plotly() {
  loading ??= new Promise((resolve, reject) => {
    const mark = document.createElement("meta");
    mark.id = GEOGRAPHIC;
    const script = document.createElement("script");
    script.src = "/static/plotly.min.js";
    script.onload = () => resolve(window.Plotly);
    script.onerror = () => {
      loading = null;
      reject(new Error("the charts could not be loaded"));
    };
    document.head.append(mark, script);
  });
  return loading;
}

let drawings = 0;

/** Draws or redraws a figure. The arrays in it may be the same as before with more in them. */
export async function draw(node, data, layout) {
  const Plotly = await plotly();
  drawings += 1;
  await Plotly.react(node, data, { ...layout, datarevision: drawings }, CONFIG);
}

/** The parts of every layout that follow the theme. */
export function themed(layout) {
  const line = token("--line");
  const axis = (given) => ({ ...given, gridcolor: line, linecolor: line, zerolinecolor: line });
  const label = { bgcolor: token("--surface"), bordercolor: token("--line-strong"), font: { color: token("--ink"), size: 12 } };
  return {
    ...layout,
    font: { ...layout.font, color: token("--muted") },
    hoverlabel: { ...label, align: "left" },
    xaxis: axis(layout.xaxis),
    yaxis: axis(layout.yaxis),
  };
}

/** An array that a figure has as base64, as rows of typed arrays. */
export function unpack({ dtype, bdata, shape }) {
  const [rows, columns] = shape.split(",").map(Number);
  const raw = Uint8Array.from(atob(bdata), (character) => character.charCodeAt(0));
  const flat = new { u1: Uint8Array, i1: Int8Array, i2: Int16Array, i4: Int32Array }[dtype](raw.buffer);
  return Array.from({ length: rows }, (_, i) => flat.subarray(i * columns, (i + 1) * columns));
}
