// plotly, loaded when it is first needed, in the colours of the page. A report holds plotly.

/** @import { Axis, Layout, Plotly } from "./plotly.js" */
import { token } from "panolog/shared/dom.js";

const CONFIG = { displayModeBar: false, responsive: true, doubleClick: "reset", showTips: false };
/** @type {Promise<Plotly> | null} */
let loading = null;

export function plotly() {
  loading ??= window.Plotly
    ? Promise.resolve(window.Plotly)
    : new Promise((resolve, reject) => {
        const script = document.createElement("script");
        script.src = "/vendor/plotly.min.js";
        script.onload = () => resolve(window.Plotly);
        script.onerror = () => {
          loading = null;
          reject(new Error("the charts could not be loaded"));
        };
        document.head.append(script);
      });
  return loading;
}

/** What all curves have in common: no frame, one label for all lines, and a legend above them. */
export const CURVES = {
  margin: { l: 8, r: 10, t: 6, b: 8 },
  paper_bgcolor: "rgba(0,0,0,0)",
  plot_bgcolor: "rgba(0,0,0,0)",
  hovermode: "x unified",
  font: { family: "system-ui, sans-serif", size: 11.5 },
  legend: {
    orientation: "h",
    x: 0,
    y: 1,
    yanchor: "bottom",
    font: { size: 11 },
    itemclick: false,
    itemdoubleclick: false,
  },
};

let drawings = 0;

/**
 * Draws or redraws a figure. The arrays in it may be those of the last drawing with more in them.
 * @param {HTMLElement} node
 * @param {object[]} data
 * @param {object} layout
 */
export async function draw(node, data, layout) {
  const Plotly = await plotly();
  drawings += 1;
  await Plotly.react(node, data, { ...layout, datarevision: drawings }, CONFIG);
}

/** A layout in the colours of the theme. @param {Layout} layout @returns {Layout} */
export function themed(layout) {
  const line = token("--line");
  /** @param {Axis} given @returns {Axis} */
  const axis = (given) => ({ ...given, gridcolor: line, linecolor: line, zerolinecolor: line });
  const label = {
    bgcolor: token("--surface"),
    bordercolor: token("--line-strong"),
    font: { color: token("--ink"), size: 12 },
  };
  return {
    ...layout,
    font: { ...layout.font, color: token("--muted") },
    hoverlabel: { ...label, align: "left" },
    xaxis: axis(layout.xaxis),
    yaxis: axis(layout.yaxis),
  };
}
