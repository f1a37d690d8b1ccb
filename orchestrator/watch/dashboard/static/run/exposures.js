// How bright each training panorama is, as Stage I has learnt it.

/** @import { ExposureCurve, RunPage } from "../shared/messages.js" */
import { get } from "panolog/shared/api.js";
import { byId, token } from "panolog/shared/dom.js";
import { CURVES, draw, themed } from "panolog/shared/plot.js";

/** @type {[keyof Omit<ExposureCurve, "name">, string, string][]} */
const LINES = [
  ["red", "red", "#d63c3c"],
  ["green", "green", "#2b9c5a"],
  ["blue", "blue", "#2f6fe0"],
  ["stops", "mean", ""],
];

/** @param {HTMLElement} node @param {ExposureCurve} curve */
async function drawExposure(node, curve) {
  const traces = LINES.map(([key, label, color]) => ({
    type: "scatter",
    mode: "lines",
    name: label,
    x: curve.name.map((_, i) => i + 1),
    y: curve[key],
    text: curve.name,
    line: { color: color || token("--ink"), width: key === "stops" ? 2.2 : 1.2 },
    hovertemplate: "%{y:+.2f} %{text}",
  }));
  await draw(
    node,
    traces,
    themed({
      ...CURVES,
      showlegend: true,
      dragmode: false,
      xaxis: {
        automargin: true,
        zeroline: false,
        nticks: 8,
        title: { text: "training panorama", standoff: 6, font: { size: 11.5 } },
      },
      yaxis: { automargin: true, type: "linear", zeroline: true, nticks: 6 },
    }),
  );
}

/** @param {string} path of the run below /api */
export function exposures(path) {
  const card = byId("exposure");
  /** @type {string | null} */
  let version = null;
  /** @type {ExposureCurve | null} */
  let curve = null;

  async function render() {
    card.hidden = byId("to-exposure").hidden = !curve;
    if (!curve) return;
    await drawExposure(byId("exposure-plot"), curve);
  }

  document.addEventListener("themechange", render);
  return {
    /** @param {RunPage} run */
    async update({ result }) {
      if (result.exposure === version) return;
      version = result.exposure;
      curve = version === null ? null : await get(`${path}/exposure`).catch(() => null);
      await render();
    },
  };
}
