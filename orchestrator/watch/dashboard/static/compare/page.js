// The page that compares runs: which ones the address says, and it follows them while they train.

import { comparedCurves } from "panolog/compare/compared_curves.js";
import { heldOut } from "panolog/compare/held_out.js";
import { runMark, showFacts, showMetrics, showSettings, showWarnings } from "panolog/compare/tables.js";
/** @import { ComparedRun, Comparison, RunList } from "../shared/messages.js" */
import { connectionLine, get, messageOf, snapshot, statusOf, stream } from "panolog/shared/api.js";
import { byId, el, replaceIfChanged, setMessage, throttled } from "panolog/shared/dom.js";

const POLL = 2000; // milliseconds between two readings of runs that train
const CURVES = 5000; // the same of their curves
const ids = [...new Set(new URLSearchParams(location.search).getAll("run"))];

/** @param {string[]} runs */
const queryOf = (runs) => runs.map((id) => `run=${encodeURIComponent(id)}`).join("&");

const curves = comparedCurves();
const panoramas = heldOut();
/** @type {Comparison | null} */
let known = null;
/** When the connection was lost, in seconds since the epoch; null while there is one. @type {number | null} */
let lost = null;
let seen = "";

/** A run of the comparison, with what changes the comparison. @param {ComparedRun} run @param {number} index */
function chosenItem(run, index) {
  const others = ids.filter((id) => id !== run.id);
  const name = run.error
    ? el("span", {}, run.name)
    : el("a", { href: `/runs/${encodeURIComponent(run.id)}` }, run.name);
  return el(
    "li",
    {},
    runMark(run),
    name,
    index > 0 &&
      !run.error &&
      el(
        "a",
        {
          class: "button",
          href: `/compare?${queryOf([run.id, ...others])}`,
          "aria-label": `Compare the others with ${run.name}`,
        },
        "Compare with this",
      ),
    ids.length > 2 &&
      el(
        "a",
        { class: "button", href: `/compare?${queryOf(others)}`, "aria-label": `Leave ${run.name} out` },
        "Leave out",
      ),
  );
}

function show() {
  if (!known) return;
  const { runs } = known;
  byId("content").hidden = false;
  byId("missing").hidden = true;
  document.title = `${runs.map(({ name }) => name).join(" | ")} · PanoLOG`;
  if (!snapshot)
    replaceIfChanged(
      byId("chosen"),
      runs.map(({ id, name, error, color }) => [id, name, error, color]),
      () => runs.map(chosenItem),
    );
  showWarnings(known);
  showFacts(known, lost !== null);
  showMetrics(known);
  showSettings(known);
  curves.update(runs);
  panoramas.update(known);
}

async function refresh() {
  try {
    known = await get(`compare?${queryOf(ids)}`);
    show();
  } catch (error) {
    if (statusOf(error) === undefined) return; // no server: the line above says so
    setMessage(
      byId("missing"),
      statusOf(error) === 422
        ? "Choose two to eight runs in the list of all runs, and then Compare."
        : messageOf(error),
    );
    byId("content").hidden = true;
  }
}

async function refreshCurves() {
  const sent = await get(`compare/curves?${queryOf(ids)}`).catch(() => null); // the comparison itself says why
  if (sent) await curves.add(sent);
}
const [soon, curvesSoon] = [throttled(refresh, POLL), throttled(refreshCurves, CURVES)];

const line = connectionLine(
  (time) => {
    lost = time;
    show();
  },
  () => " — below is the last known state; trying again …",
);

document.addEventListener("themechange", () => curves.render());
stream(
  "",
  line.good,
  (refused) => {
    line.lost();
    if (refused) refresh(); // perhaps only the stream is: there may be too many pages
  },
  {
    /** The list of runs: of what is compared here, some may have changed. @param {RunList} message */
    runs({ runs }) {
      line.good();
      const rows = JSON.stringify(runs.filter(({ id }) => ids.includes(id)));
      if (rows === seen && known) return;
      seen = rows;
      soon();
      curvesSoon();
    },
  },
);
