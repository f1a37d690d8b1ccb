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

function show(run) {
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
stream(`?run=${encodeURIComponent(id)}`, {
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
  events: ({ events: news }) => {
    events.add(news);
    charts.add(news);
    pictures.add(news);
  },
});
