// How bright each training panorama is, as Stage I has learnt it.

/** @import { ExposureCurve, RunPage } from "../shared/messages.js" */
import { get } from "../shared/api.js";
import { byId } from "../shared/dom.js";
import { drawExposure } from "./exposure_curve.js";

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
