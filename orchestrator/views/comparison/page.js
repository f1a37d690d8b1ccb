// A report of several runs in the browser. It is put into the page after the scripts that it imports, without the imports.

/** @import { Comparison, CurvesOfRuns } from "../../dashboard/static/shared/messages.js" */
import { byId } from "../../dashboard/static/shared/dom.js";
import { comparedCurves } from "../../dashboard/static/compare/compared_curves.js";
import { heldOut } from "../../dashboard/static/compare/held_out.js";
import { showFacts, showMetrics, showSettings, showWarnings } from "../../dashboard/static/compare/tables.js";

/** @type {{comparison: Comparison, curves: CurvesOfRuns}} */
const written = JSON.parse(byId("data").textContent ?? "");
showWarnings(written.comparison);
showFacts(written.comparison, false);
showMetrics(written.comparison);
showSettings(written.comparison);
heldOut().update(written.comparison);
const drawn = comparedCurves();
drawn.update(written.comparison.runs);
drawn.add(written.curves);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawn.render());
