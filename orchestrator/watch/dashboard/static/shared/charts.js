// The curves of tasks that train: loss, PSNR, Gaussians, speed, memory and learning rates.

/** @import { Series } from "./messages.js" */
/** @import { Layout } from "./plotly.js" */
import { CURVES } from "panolog/shared/plot.js";

/** The curves of a task by name. @typedef {Record<string, Series>} TaskSeries */
/** A task with curves. @typedef {{label: string, color: string, series: TaskSeries}} Curve */
/** @typedef {{key: string, title: string, unit: string, size?: number}} ChartKind */

/** Whether the page is as narrow as a phone's. */
export const narrow = matchMedia("(max-width: 720px)");
const RATES = "rate/"; // and the name of a parameter
/** `size` is the unit in what the records hold. @type {ChartKind[]} */
export const CHARTS = [
  { key: "loss", title: "Training loss", unit: "" },
  { key: "psnr", title: "PSNR of training views", unit: "dB" },
  { key: "gaussians", title: "Gaussians in training", unit: "" },
  { key: "rate", title: "Speed", unit: "iterations per second" },
  { key: "memory", title: "Memory", unit: "GiB", size: 2 ** 30 },
  { key: RATES, title: "Learning rates", unit: "log scale" },
];
/** The parameters of a Gaussian with the dashes of their learning rates. @type {Record<string, [string, string]>} */
const PARAMETERS = {
  means: ["position", "solid"],
  scales: ["scale", "dash"],
  quats: ["rotation", "dot"],
  opacities: ["opacity", "dashdot"],
  sh0: ["base colour", "longdash"],
  shN: ["SH colour", "longdashdot"],
};

/** @param {ChartKind} kind */
export const chartTitle = ({ title, unit }) => (unit ? `${title}, ${unit}` : title);

/** @param {string} name of a curve */
const parameter = (name) => PARAMETERS[name.slice(RATES.length)] ?? [name.slice(RATES.length), "solid"];

/** The lines of a chart; of learning rates one for each parameter, and an entry of the legend for each. @param {ChartKind} kind @param {Curve[]} curves */
export function chartTraces({ key, size }, curves) {
  /** @param {string} name */
  const wanted = (name) => (key === RATES ? name.startsWith(RATES) : name === key);
  const lines = curves.flatMap(({ label, color, series }) =>
    Object.entries(series)
      .filter(([name]) => wanted(name))
      .map(([name, { iteration, value }]) => {
        const [rate, dash] = key === RATES ? parameter(name) : ["", "solid"];
        return {
          type: "scatter",
          mode: value.length > 1 ? "lines" : "markers",
          x: iteration,
          y: size ? value.map((one) => one && one / size) : value,
          name: rate ? `${label}, ${rate}` : label,
          line: { color, width: 1.7, dash },
          showlegend: false,
          hovertemplate: "%{y:.4~g}",
        };
      }),
  );
  if (key !== RATES) return lines;
  const names = new Set(curves.flatMap(({ series }) => Object.keys(series).filter(wanted)));
  const entries = [...names].map(parameter).map(([name, dash]) => ({
    type: "scatter",
    mode: "lines",
    x: [null],
    y: [null],
    name,
    line: { color: "#7b8696", width: 1.7, dash },
    showlegend: true,
    hoverinfo: "skip",
  }));
  return [...lines, ...entries];
}

/** @param {ChartKind} kind @returns {Layout} */
export function chartLayout({ key }) {
  const log = key === RATES;
  return {
    ...CURVES,
    showlegend: log,
    legend: {
      ...CURVES.legend,
      itemwidth: 30,
      entrywidth: narrow.matches ? 0.5 : 0.33,
      entrywidthmode: "fraction",
    },
    dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
    uirevision: "curves",
    xaxis: {
      automargin: true,
      rangemode: "tozero",
      zeroline: false,
      nticks: 6,
      title: { text: "iteration", standoff: 6, font: { size: 11.5 } },
    },
    yaxis: {
      automargin: true,
      type: log ? "log" : "linear",
      zeroline: false,
      ...(log ? { dtick: 1, exponentformat: "power" } : { nticks: 6, exponentformat: "SI" }),
    },
  };
}
