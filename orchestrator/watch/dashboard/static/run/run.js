// The page of one run: passes the server's messages to its parts.

import { actions } from "panolog/run/actions.js";
import { blockTable } from "panolog/run/blocks.js";
import { curves } from "panolog/run/curves.js";
import { exposures } from "panolog/run/exposures.js";
import { findings } from "panolog/run/findings.js";
import { log } from "panolog/run/log.js";
import { planMap } from "panolog/run/map.js";
import { machines, overview, settings } from "panolog/run/overview.js";
import { preparation } from "panolog/run/preparation.js";
import { report } from "panolog/run/report.js";
import { blockStatuses, trainingRows } from "panolog/run/rows.js";
import { selection } from "panolog/run/selection.js";
import { views } from "panolog/run/views.js";
/** @import { EventList, RunChanges, RunPage } from "../shared/messages.js" */
import { connectionLine, get, messageOf, snapshot, statusOf, stream } from "panolog/shared/api.js";
import { byId, setMessage } from "panolog/shared/dom.js";
import { shellWord } from "panolog/shared/format.js";

const id = snapshot ? "report" : encodeURIComponent(location.pathname.split("/").filter(Boolean).pop() ?? "");
const path = `runs/${id}`;

/**
 * What a click anywhere on the page selects everywhere.
 * @typedef {typeof choose} Choose
 */
const choose = {
  /** @param {number} block */
  block(block) {
    table.mark(block);
    selected.block(block);
    map.mark(block);
  },
  /** @param {number} row */
  async camera(row) {
    table.mark(null);
    map.mark(null, row);
    await selected.camera(row);
  },
  /** @param {string} task */
  curve(task) {
    charts.toggle(task, true);
    const folded = document.querySelector("#curves.folded .fold");
    if (folded instanceof HTMLElement) folded.click();
    byId("curves").scrollIntoView();
  },
  /** @param {string} task */
  preview(task) {
    pictures.choose(task);
    byId("views").scrollIntoView();
  },
  /** @param {string} name of a held-out panorama */
  view(name) {
    pictures.chooseView(name);
    byId("views").scrollIntoView();
  },
  /** The map is there. @param {string[]} colors */
  mapped(colors) {
    charts.colors(colors);
    selected.mapped();
  },
};

const acts = actions(path);
const head = overview();
const prepared = preparation(path);
const map = planMap(path, choose);
const table = blockTable(choose);
const charts = curves(path, table);
const exposed = exposures(path);
const measured = findings(path, choose);
const selected = selection(path, choose, acts, map);
const pictures = views(path);
const events = log(path);
const hosts = machines(acts);
const options = settings();

/** The run as the server has sent it last. @type {RunPage | null} */
let known = null;
/** When the connection was lost, in seconds since the epoch; null while there is one. A report has none. @type {number | null} */
let lost = snapshot ? 0 : null;

/** A run without what was true only when it was sent: times left and speeds. @param {RunPage} run @returns {RunPage} */
function lastKnown(run) {
  const tasks = run.summary.tasks.map((task) => ({ ...task, eta: null, rate: null }));
  const nodes = run.nodes.map((node) => ({ ...node, rate: 0 }));
  return { ...run, eta: null, nodes, summary: { ...run.summary, eta: null, tasks } };
}

/** @param {RunPage} sent */
function show(sent) {
  known = sent;
  const run = lost === null || snapshot ? sent : lastKnown(sent);
  byId("content").hidden = false;
  byId("missing").hidden = true;
  const rows = trainingRows(run);
  head.update(run, lost);
  if (snapshot) report(path, run);
  else acts.update(run);
  prepared.update(run, lost === null);
  map.update(run, blockStatuses(run));
  table.update(rows, run.summary.status === "running");
  charts.update(rows);
  exposed.update(run);
  measured.update(run);
  selected.update(run, rows);
  pictures.update(run);
  events.update(run);
  hosts.update(run);
  options.update(run);
}

/** A run after a message with changes. @param {RunPage} run @param {RunChanges} changes @returns {RunPage} */
function changed(run, { tasks, summary, ...rest }) {
  const all = new Map([...run.summary.tasks, ...tasks].map((task) => [task.name, task]));
  return { ...run, ...rest, summary: { ...run.summary, ...summary, tasks: [...all.values()] } };
}

/** Shows why the stream was refused, or the run if only the stream was: there may be too many pages. */
async function explain() {
  try {
    show(await get(path));
  } catch (error) {
    const status = statusOf(error);
    if (status === undefined) return; // no server: the line above says so
    setMessage(byId("missing"), status === 404 ? "There is no such run here, or it was removed." : messageOf(error));
    line.good(); // the server has answered
    byId("content").hidden = status === 404;
  }
}

/** What the line without a connection says of the run: a server that ended with its run will not come back. */
function lastState() {
  if (!known) return ", trying again …";
  const { status, label } = known.summary;
  const then =
    status === "running" ? "; trying again …" : `. To open it again: panolog dashboard ${shellWord(known.path)}`;
  return ` — last state: ${label}${then}`;
}

const line = connectionLine((time) => {
  lost = time;
  if (known) show(known);
}, lastState);
stream(
  `?run=${id}&changes=1`,
  () => {
    line.good();
    events.refresh();
    charts.refresh();
    pictures.refresh();
  },
  (refused) => {
    line.lost();
    if (refused) explain();
  },
  {
    /** @param {RunPage} run */
    run(run) {
      line.good();
      show(run);
    },
    /** @param {RunChanges} changes */
    changes(changes) {
      if (known) show(changed(known, changes));
    },
    /** @param {{error: string}} message */
    gone({ error }) {
      line.lost(`The run cannot be read: ${error}`);
    },
    /** @param {EventList} message */
    events({ events: recent }) {
      events.add(recent);
      charts.add(recent);
      pictures.add(recent);
    },
  },
);
