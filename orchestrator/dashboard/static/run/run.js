// The page of one run: passes the server's messages to its parts.

/** @import { EventList, RunChanges, RunPage } from "../shared/messages.js" */
import { connectionLine, get, messageOf, statusOf, stream } from "../shared/api.js";
import { byId, setMessage } from "../shared/dom.js";
import { actions } from "./actions.js";
import { blockTable } from "./blocks.js";
import { curves } from "./curves.js";
import { log } from "./log.js";
import { planMap } from "./map.js";
import { machines, overview, settings } from "./overview.js";
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
const map = planMap(path, choose);
const table = blockTable(choose);
const charts = curves(path, table);
const selected = selection(path, choose, acts, map);
const pictures = views(path);
const events = log(path);
const hosts = machines();
const options = settings();

/** The run as it was last shown. @type {RunPage | null} */
let shown = null;

/** @param {RunPage} run */
function show(run) {
  shown = run;
  byId("content").hidden = false;
  byId("missing").hidden = true;
  const rows = trainingRows(run);
  head.update(run);
  acts.update(run);
  map.update(run, blockStatuses(run));
  table.update(rows);
  charts.update(rows);
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
    setMessage(byId("missing"), status === 404 ? "There is no such run here (any more)." : messageOf(error));
    byId("content").hidden = status === 404;
  }
}

const line = connectionLine();
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
    if (shown) show(changed(shown, changes));
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
