// report.html in the browser: the map, the curves, and a slider with a 360° view for each picture. It is put into the
// page after the scripts that it imports, without the imports.

/** @import { TaskSeries } from "../dashboard/static/shared/charts.js" */
/** @import { ExposureCurve } from "../dashboard/static/shared/messages.js" */
/** @import { MapFigure } from "../dashboard/static/shared/plotly.js" */
import { drawExposure } from "../dashboard/static/run/exposure_curve.js";
import { draw, themed } from "../dashboard/static/run/plot.js";
import { CHARTS, chartLayout, chartTitle, chartTraces } from "../dashboard/static/shared/charts.js";
import { comparison, projections } from "../dashboard/static/shared/compare.js";
import { byId, el, first, token } from "../dashboard/static/shared/dom.js";

const SHOWN = 8; // tasks whose curves are shown at first
/** `color` is null for Stage I. @type {{map: MapFigure | null, exposure: ExposureCurve | null, curves: {label: string, color: string | null, series: TaskSeries}[]}} */
const report = JSON.parse(byId("data").textContent ?? "");
const shown = new Set(report.curves.slice(0, SHOWN));
const charts = CHARTS.filter(({ key }) => report.curves.some(({ series }) => Object.keys(series).some((name) => name.startsWith(key))))
  .map((kind) => ({ kind, node: el("div", { class: "plot chart", role: "img", "aria-label": chartTitle(kind) }) }));

function drawMap() {
  if (!report.map) return;
  const [ink, surface] = [token("--ink"), token("--surface")];
  for (const { name, marker, textfont } of report.map.data) {
    if (name === "labels") [marker.color, textfont.color] = [surface, ink];
    else if (marker) marker.line.color = surface;
  }
  draw(byId("map"), report.map.data, { ...themed(report.map.layout), dragmode: false });
}

function drawCurves() {
  const curves = report.curves.filter((curve) => shown.has(curve)).map((curve) => ({ ...curve, color: curve.color ?? token("--ink") }));
  for (const { kind, node } of charts) draw(node, chartTraces(kind, curves), themed(chartLayout(kind)));
}

/** A button that shows and hides the curves of a task. @param {typeof report.curves[number]} curve */
function chip(curve) {
  const mark = el("span", { class: "chip", style: `background: ${curve.color ?? "var(--ink)"}` });
  const button = el("button", { type: "button", class: "chip-button", "aria-pressed": String(shown.has(curve)) }, mark, curve.label);
  button.addEventListener("click", () => {
    if (!shown.delete(curve)) shown.add(curve);
    button.setAttribute("aria-pressed", String(shown.has(curve)));
    drawCurves();
  });
  return button;
}

/** Puts the slider in the place of a picture. @param {HTMLElement} figure */
function compareIn(figure) {
  const picture = first("img", figure);
  const compared = comparison(figure.dataset.name ?? "");
  const flat = el("button", { type: "button", "aria-pressed": "true" }, "Flat");
  const around = el("button", { type: "button", "aria-pressed": "false" }, "360°");
  projections(flat, around, compared);
  compared.show(picture.getAttribute("src") ?? "");
  picture.replaceWith(compared.box, el("div", { class: "segments", role: "group", "aria-label": "Projection" }, flat, around));
}

if (report.curves.length) {
  byId("charts").append(...charts.map(({ kind, node }) => el("figure", {}, el("figcaption", {}, chartTitle(kind)), node)));
  byId("shown").append(...report.curves.map(chip));
}
for (const figure of document.querySelectorAll(".pictures figure")) compareIn(/** @type {HTMLElement} */ (figure));
const drawAll = () => {
  drawMap();
  drawCurves();
  if (report.exposure) drawExposure(byId("exposure"), report.exposure);
};
drawAll();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
