// The queue above the list of runs: in its order, with buttons that move, remove and retry entries, and handles
// by which those that wait are dragged.

import { draggable } from "panolog/runs/drag.js";
/** @import { QueueList, QueueRow } from "../shared/messages.js" */
import { messageOf, post } from "panolog/shared/api.js";
import { confirm } from "panolog/shared/confirm.js";
import { byId, el, first, pill, reconcile, setMessage, setPill, setText } from "panolog/shared/dom.js";
import { ago } from "panolog/shared/format.js";

/** @typedef {"up" | "down" | "retry" | "remove"} Button */
/** What each button shows, and what screen readers say; {} is the run. @type {Record<Button, [string, string]>} */
const BUTTONS = {
  up: ["↑", "Move {} up"],
  down: ["↓", "Move {} down"],
  retry: ["Retry", "Retry {}"],
  remove: ["Remove", "Remove {}"],
};
/** What the last update has shown. @type {QueueRow[]} */
let rows = [];

const waiting = () => rows.filter((row) => row.state === "waiting");

/** Why a button is not possible; empty if it is. @param {Button} button @param {QueueRow} row */
function refusal(button, row) {
  const order = waiting();
  if (button === "up") return order[0]?.id === row.id ? "it is the first that waits" : "";
  if (button === "down") return order.at(-1)?.id === row.id ? "it is the last that waits" : "";
  return "";
}

/** The buttons of an entry. @param {QueueRow} row @returns {Button[]} */
function buttonsOf(row) {
  if (row.state === "waiting") return ["up", "down", "remove"];
  if (row.state === "running") return row.label === "interrupted" ? ["remove"] : [];
  return row.state === "done" ? ["remove"] : ["retry", "remove"];
}

/** @param {QueueRow} row @param {string} action @param {number | null} before @param {string} said */
async function request(row, action, before, said) {
  await post("queue", { action, entry: row.id, before });
  setText(byId("queue-said"), said);
}

/** What a click on a button does. @param {Button} button @param {number} id */
async function act(button, id) {
  const row = rows.find((one) => one.id === id);
  if (!row || refusal(button, row)) return;
  if (button === "remove") {
    const text = "It is not run any more. Its run folder, if there is one, stays as it is.";
    confirm([`Remove ${row.name} from the queue?`, text, "Remove"], true, () =>
      request(row, "remove", null, `${row.name} is removed`),
    );
    return;
  }
  const order = waiting().map((one) => one.id);
  const at = order.indexOf(id);
  const before = button === "up" ? order[at - 1] : button === "down" ? (order[at + 2] ?? null) : null;
  if (button === "retry") await attempt(row, "retry", null, `${row.name} waits again`);
  else await attempt(row, "move", before, `${row.name} is moved ${button}`);
}

/** Requests it, and shows why it is not possible. @type {typeof request} */
async function attempt(row, action, before, said) {
  try {
    await request(row, action, before, said);
    setMessage(byId("queue-error"), "");
  } catch (error) {
    setMessage(byId("queue-error"), `Not possible: ${messageOf(error)}`);
  }
}

/** What follows when a row was dragged to a place among those that wait. @param {string} key @param {number} place */
function drop(key, place) {
  const order = waiting();
  const row = order.find((one) => String(one.id) === key);
  if (!row || order[place] === row) return;
  const others = order.filter((one) => one !== row);
  attempt(row, "move", others[place]?.id ?? null, `${row.name} is moved to place ${place + 1}`);
}

/** @param {QueueRow} row */
function makeRow(row) {
  const place = el("span", { class: "queue-place", "aria-hidden": "true" });
  const name = el("div", { class: "queue-name" }, el("a", { class: "run-name" }), el("span", { class: "scene" }));
  const node = el("li", {}, place, name, pill(row.state), el("div", { class: "queue-buttons" }));
  draggable(place, node, drop);
  return node;
}

/** @param {HTMLElement} node @param {QueueRow} row */
function fillRow(node, row) {
  const place = waiting().findIndex((one) => one.id === row.id);
  const handle = first(".queue-place", node);
  setText(handle, place < 0 ? "" : `${place + 1}`);
  handle.title = place < 0 ? "" : "Drag to move it";
  node.classList.toggle("waits", place >= 0);
  const link = first(".run-name", node);
  setText(link, row.name);
  if (row.run) link.setAttribute("href", `/runs/${row.run}`);
  else link.removeAttribute("href");
  const verb = row.state === "waiting" ? "added" : row.state === "running" ? "started" : "ended";
  setText(first(".scene", node), row.reason || [`${verb} ${ago(row.time)}`, row.share].filter(Boolean).join(" · "));
  setPill(first(".pill", node), row.label);
  const wanted = buttonsOf(row);
  reconcile(
    first(".queue-buttons", node),
    wanted,
    String,
    (button) => {
      const [text, label] = BUTTONS[button];
      const words = {
        type: "button",
        class: "queue-button",
        "data-action": button,
        "aria-label": label.replace("{}", row.name),
      };
      return el("button", { ...words, on: { click: () => act(button, row.id) } }, text);
    },
    (shown, button) => {
      const why = refusal(button, row);
      shown.setAttribute("aria-disabled", String(Boolean(why)));
      shown.title = why;
    },
  );
}

/** Shows the queue, if there is one. @param {QueueList | null} queue */
export function showQueue(queue) {
  byId("queue").hidden = !queue;
  if (!queue) return;
  rows = queue.entries;
  const open = rows.some((row) => row.state === "waiting" || row.state === "running");
  const hint = open ? "No runner is at work: panolog queue run starts one" : "";
  setText(byId("queue-runner"), queue.error || (queue.runner ? "A runner is at work" : hint));
  byId("queue-runner").classList.toggle("error", Boolean(queue.error));
  const list = byId("queue-entries");
  const active = list.contains(document.activeElement) ? /** @type {HTMLElement} */ (document.activeElement) : null;
  const [entry, button] = [active?.closest("li")?.dataset.key, active?.dataset.action];
  reconcile(list, rows, (row) => String(row.id), makeRow, fillRow);
  // a row that is moved in the document loses the focus
  if (entry && document.activeElement !== active)
    first(`li[data-key="${entry}"] [data-action="${button}"]`, list)?.focus();
  const more = queue.hidden ? `${queue.hidden} more are not shown; panolog queue list shows all.` : "";
  setMessage(
    byId("queue-more"),
    rows.length || queue.error ? more : "The queue is empty. Add a run with: panolog queue add SCENE -o RUN",
  );
}
