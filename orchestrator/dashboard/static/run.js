// The page of one run: takes what the server says and hands it to the parts.

import { actions } from "./actions.js";
import { get, stream } from "./api.js";
import { blockTable } from "./blocks.js";
import { connectionLine } from "./connection.js";
import { curves } from "./curves.js";
import { byId, setText } from "./dom.js";
import { overview } from "./overview.js";
import { log } from "./log.js";
import { planMap } from "./map.js";
import { machines } from "./machines.js";
import { selection } from "./selection.js";
import { settings } from "./settings.js";
import { standingsOf, trainingTasks } from "./standings.js";
import { views } from "./views.js";

const id = location.pathname.split("/").filter(Boolean).pop();
const path = `runs/${encodeURIComponent(id)}`;

/** A block or camera that is chosen anywhere is chosen everywhere. */
const choose = {
  block(block) {
    table.mark(block);
    selected.block(block);
    map.mark(block);
  },
  async camera(row) {
    table.mark(null);
    map.mark(null, row);
    await selected.camera(row);
  },
  curve(task) {
    charts.toggle(task, true);
    byId("curves").scrollIntoView();
  },
  preview(task) {
    pictures.choose(task);
    byId("views").scrollIntoView();
  },
  mapped(colors) {
    charts.colors(colors);
    selected.mapped();
  },
};

const acts = actions(path);
const top = overview();
const map = planMap(path, choose);
const table = blockTable(choose);
const charts = curves(path, table);
const selected = selection(path, choose, acts, map);
const pictures = views(path);
const events = log(path);
const hosts = machines();
const options = settings();

let known = null; // the run as it was last shown

function show(run) {
  known = run;
  byId("content").hidden = false;
  byId("missing").hidden = true;
  const tasks = trainingTasks(run);
  const standings = standingsOf(run);
  top.update(run);
  acts.update(run);
  map.update(run, standings);
  table.update(run, tasks);
  charts.update(run, tasks);
  selected.update(run, tasks);
  pictures.update(run, tasks);
  events.update(run);
  hosts.update(run);
  options.update(run);
}

/** The truth after a message that only tells what is different. */
function changed({ tasks, summary, ...rest }) {
  const fresh = new Map(tasks.map((task) => [task.name, task]));
  const kept = known.summary.tasks.map((task) => fresh.get(task.name) ?? task);
  const names = new Set(kept.map((task) => task.name));
  const all = [...kept, ...tasks.filter((task) => !names.has(task.name))];
  return { ...known, ...rest, summary: { ...known.summary, ...summary, tasks: all } };
}

async function explain() {
  try {
    show(await get(path)); // the stream alone is refused: too many pages, perhaps
  } catch (error) {
    if (error.status === undefined) return; // nobody there: the line above says so
    const gone = error.status === 404 ? "There is no such run here (any more)." : error.message;
    setText(byId("missing"), error.status === 401 ? "This dashboard asks for a token: open the link that it printed." : gone);
    byId("missing").hidden = false;
    byId("content").hidden = error.status === 404;
  }
}

const line = connectionLine();
stream(`?run=${encodeURIComponent(id)}&changes=1`, {
  open: () => {
    line.good();
    events.refresh();
    charts.refresh();
    pictures.refresh();
  },
  lost: (refused) => {
    line.lost();
    if (refused) explain();
  },
  run: (run) => {
    line.good();
    show(run);
  },
  changes: (news) => {
    if (known) show(changed(news));
  },
  gone: ({ error }) => line.lost(`The run cannot be read: ${error}`),
  events: ({ events: news }) => {
    events.add(news);
    charts.add(news);
    pictures.add(news);
  },
});
