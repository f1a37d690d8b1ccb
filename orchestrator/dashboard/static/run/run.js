// The page of one run: passes the server's messages to its parts.

/** @import { EventList, RunChanges, RunPage } from "../shared/messages.js" */
import { connectionLine, get, messageOf, statusOf, stream } from "../shared/api.js";
import { byId, setMessage } from "../shared/dom.js";
import { shellWord } from "../shared/format.js";
import { actions } from "./actions.js";
import { blockTable } from "./blocks.js";
import { curves } from "./curves.js";
import { exposures } from "./exposures.js";
import { log } from "./log.js";
import { planMap } from "./map.js";
import { machines, overview, settings } from "./overview.js";
import { preparation } from "./preparation.js";
import { blockStatuses, trainingRows } from "./rows.js";
import { selection } from "./selection.js";
import { views } from "./views.js";

const id = encodeURIComponent(location.pathname.split("/").filter(Boolean).pop() ?? "");
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
    byId("curves").scrollIntoView();
  },
  /** @param {string} task */
  preview(task) {
    pictures.choose(task);
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
const selected = selection(path, choose, acts, map);
const pictures = views(path);
const events = log(path);
const hosts = machines(acts);
const options = settings();

/** The run as the server has sent it last. @type {RunPage | null} */
let known = null;
/** When the connection was lost, in seconds since the epoch; null while there is one. @type {number | null} */
let lost = null;

/** A run without what was true only when it was sent: times left and speeds. @param {RunPage} run @returns {RunPage} */
function lastKnown(run) {
  const tasks = run.summary.tasks.map((task) => ({ ...task, eta: null, rate: null }));
  const nodes = run.nodes.map((node) => ({ ...node, rate: 0 }));
  return { ...run, eta: null, nodes, summary: { ...run.summary, eta: null, tasks } };
}

/** @param {RunPage} sent */
function show(sent) {
  known = sent;
  const run = lost === null ? sent : lastKnown(sent);
  byId("content").hidden = false;
  byId("missing").hidden = true;
  const rows = trainingRows(run);
  head.update(run, lost);
  acts.update(run);
  prepared.update(run, lost === null);
  map.update(run, blockStatuses(run));
  table.update(rows);
  charts.update(rows);
  exposed.update(run);
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
  const then = status === "running" ? "; trying again …" : `. To open it again: panolog dashboard ${shellWord(known.path)}`;
  return ` — last state: ${label}${then}`;
}

const line = connectionLine((time) => {
  lost = time;
  document.body.classList.toggle("lost", time !== null);
  if (known) show(known);
}, lastState);
stream(`?run=${id}&changes=1`, () => {
  line.good();
  events.refresh();
  charts.refresh();
  pictures.refresh();
}, (refused) => {
  line.lost();
  if (refused) explain();
}, {
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
});
