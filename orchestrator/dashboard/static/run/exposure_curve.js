// The curve of exposures, for the page of a run and for report.html.

/** @import { ExposureCurve } from "../shared/messages.js" */
import { token } from "../shared/dom.js";
import { draw, themed } from "./plot.js";

/** @type {[keyof Omit<ExposureCurve, "name">, string, string][]} */
const LINES = [["red", "red", "#d63c3c"], ["green", "green", "#2b9c5a"], ["blue", "blue", "#2f6fe0"], ["stops", "mean", ""]];

/** @param {HTMLElement} node @param {ExposureCurve} curve */
export async function drawExposure(node, curve) {
  const traces = LINES.map(([key, label, color]) => ({
    type: "scatter", mode: "lines", name: label, x: curve.name.map((_, i) => i + 1), y: curve[key], text: curve.name,
    line: { color: color || token("--ink"), width: key === "stops" ? 2.2 : 1.2 }, hovertemplate: "%{y:+.2f} %{text}",
  }));
  await draw(node, traces, themed({
    margin: { l: 8, r: 10, t: 6, b: 8 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: true,
    legend: { orientation: "h", x: 0, y: 1, yanchor: "bottom", font: { size: 11 }, itemclick: false, itemdoubleclick: false },
    hovermode: "x unified", dragmode: false, font: { family: "system-ui, sans-serif", size: 11.5 },
    xaxis: { automargin: true, zeroline: false, nticks: 8, title: { text: "training panorama", standoff: 6, font: { size: 11.5 } } },
    yaxis: { automargin: true, type: "linear", zeroline: true, nticks: 6 },
  }));
}
