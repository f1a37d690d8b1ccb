// The events of a run, newest first, with filters. Progress is left out by default: there is too much of it.

/** @import { EventList, RunEvent, RunPage } from "../shared/messages.js" */
import { get, messageOf, snapshot } from "panolog/shared/api.js";
import { byId, el, replaceIfChanged, setText, throttled } from "panolog/shared/dom.js";
import {
  bytes,
  clock,
  count,
  decibel,
  duration,
  fixed,
  moment,
  significant,
  taskLabel,
} from "panolog/shared/format.js";

const PAGE = 100;
const KEPT = 2000; // events in the page at most
const QUIET = "quiet"; // the filter without progress
/** The label and the text of each type of event. @type {Record<string, [string, (e: RunEvent) => string]>} */
const TYPES = {
  RunBegan: ["Driver", (e) => `${e.resumed ? "resumed the run" : "started"} on ${e.host}`],
  Preparing: ["Preparing", (e) => e.step],
  PreflightSaved: [
    "Preflight",
    (e) => `about ${duration(Object.values(e.seconds).reduce((sum, seconds) => sum + (seconds ?? 0), 0))} in all`,
  ],
  TaskStarted: [
    "Started",
    (e) =>
      `attempt ${e.attempt}${e.iteration ? ` from iteration ${count(e.iteration)}` : ""} on ${e.node}, ${e.device}, ${e.threads} threads`,
  ],
  Progressed: [
    "Progress",
    (e) =>
      `${count(e.iteration)} of ${count(e.iterations)}, ${fixed(e.rate, 1)} it/s${e.loss === null ? "" : `, loss ${significant(e.loss)}`}`,
  ],
  PreviewSaved: ["Picture", (e) => `${e.view}, ${moment(e.iteration)}`],
  Noticed: ["Notice", (e) => e.message],
  CheckpointSaved: ["Checkpoint", (e) => `iteration ${count(e.iteration)}, ${bytes(e.size)}`],
  ModelSaved: ["Model", (e) => `${count(e.gaussians)} Gaussians, ${bytes(e.size)}, after ${duration(e.seconds)}`],
  ScoresSaved: ["Scores", (e) => `${count(e.cameras)} cameras`],
  PlanSaved: ["Plan", (e) => `${count(e.blocks.length)} blocks`],
  TaskFailed: [
    "Failed",
    (e) => `attempt ${e.attempt}: ${e.reason}; ${e.then || (e.final ? "given up" : "trying again")}`,
  ],
  Merged: ["Merged", (e) => `${count(e.gaussians)} Gaussians, ${count(e.sky)} of them sky, ${bytes(e.size)}`],
  ViewEvaluated: ["View", (e) => `${e.view}: PSNR ${decibel(e.metrics.psnr)}, SSIM ${fixed(e.metrics.ssim, 4)}`],
  SeamEvaluated: ["Seam", (e) => `blocks ${e.face}: ${fixed(e.seam)}`],
  Delivered: ["Delivered", (e) => (e.path ? `${e.path}, ${bytes(e.size)}, after ${duration(e.seconds)}` : "")],
  MeasuresSaved: ["Measures", (e) => `${count(e.views)} panoramas, ${count(e.faces)} seams`],
  EvaluationSaved: [
    "Metrics",
    ({ metrics: { psnr, ssim } }) =>
      psnr === undefined ? "nothing is held out" : `PSNR ${decibel(psnr)}, SSIM ${fixed(ssim, 4)}`,
  ],
  Transferred: ["Moved", (e) => `${bytes(e.received)} received, ${bytes(e.sent)} sent`],
  StopRequested: [
    "Stop",
    (e) =>
      e.tasks
        ? `${e.tasks > 1 ? `${count(e.tasks)} tasks save` : "a task saves"} a checkpoint first`
        : "no task is in training",
  ],
  PauseRequested: ["Pause requested", () => "saves a checkpoint, then waits"],
  UnpauseRequested: ["Resume requested", () => "resumes when a worker is free"],
  RetryRequested: ["Retry requested", () => "gets all its attempts again"],
  TaskYielded: [
    "Yielded",
    (e) => `saved a checkpoint and freed its worker${e.leaves ? `, and moves: ${e.leaves} leaves` : ""}`,
  ],
  RunWaiting: ["Waiting", (e) => e.reason],
  RunContinued: ["Continued", (e) => `after ${duration(e.seconds)}`],
  NodeQuarantined: ["Quarantine", (e) => `${e.host} gets no tasks until ${clock(e.until)}: ${e.reason}`],
  NodeReleased: ["Released", (e) => `${e.host} is used again: ${e.reason}`],
  NodeLeaving: [
    "Leaves",
    (e) =>
      `${e.host} announces that it leaves${e.seconds === null ? "" : ` in ${duration(e.seconds)}`} (${e.kind}): its tasks save a checkpoint and move`,
  ],
  NodeStaying: ["Stays", (e) => `${e.host} stays after all, and is used again`],
  NodeLeft: ["Left", (e) => `${e.host} has left`],
  NodeReserved: ["Machine", (e) => `${e.host} is there: ${e.kind}${e.price === null ? "" : `, ${e.price} per hour`}`],
  NodeReturned: ["Machine", () => "one is there no longer"],
  WorkLost: ["Lost", (e) => `${duration(e.seconds)} since the last checkpoint`],
  BudgetSet: [
    "Limits",
    (e) =>
      [
        e.max_cost === null ? "" : `at most ${e.max_cost} ${e.prices.currency}`,
        e.deadline === null ? "" : `until ${clock(e.deadline)}`,
      ]
        .filter(Boolean)
        .join(", ") || "none",
  ],
  BudgetNear: ["Limit near", (e) => e.what],
  BudgetReached: ["Limit reached", (e) => e.reason],
  RunEnded: [
    "Ended",
    (e) =>
      [{ interrupted: "stopped", limited: "ended early" }[String(e.outcome)] ?? e.outcome, e.reason]
        .filter(Boolean)
        .join(": "),
  ],
};

/** @param {RunEvent} event */
function line(event) {
  const [label, describe] = TYPES[event.type] ?? [event.type, () => ""];
  const tone =
    event.type === "TaskFailed" || event.outcome === "failed"
      ? "failed"
      : ["Noticed", "RunWaiting", "BudgetNear", "BudgetReached", "WorkLost"].includes(event.type)
        ? "paused"
        : event.type.endsWith("Saved") || event.outcome === "done"
          ? "done"
          : "waiting";
  const time = el("time", { datetime: new Date(event.time * 1000).toISOString() }, clock(event.time));
  const detail =
    event.detail && el("details", {}, el("summary", {}, "Traceback"), el("pre", { tabindex: 0 }, event.detail));
  return el(
    "li",
    { "data-key": event.id },
    time,
    el("span", { class: "kind", "data-status": tone }, label),
    el("span", { class: "task" }, taskLabel(event.task)),
    el("span", { class: "what" }, describe(event), detail),
  );
}

/** @param {string} path of the run below /api */
export function log(path) {
  const [list, empty, older] = [byId("events"), byId("log-empty"), byId("older")];
  const filters = {
    type: byId("log-type", HTMLSelectElement),
    task: byId("log-task", HTMLSelectElement),
    text: byId("log-text", HTMLInputElement),
  };
  /** The id before which older events start. @type {number | null} */
  let oldest = null;
  let requests = 0; // so that a slow answer does not replace a later one
  /** What has come since the events were requested, which the answer may lack; null otherwise. @type {RunEvent[] | null} */
  let late = null;

  /** @param {string} value @param {string} label */
  const option = (value, label) => el("option", { value }, label);
  filters.type.append(
    option(QUIET, "all but progress"),
    option("", "all"),
    ...Object.entries(TYPES).map(([type, [label]]) => option(type, label)),
  );
  filters.task.append(option("", "all"));

  /** @param {number | null} before */
  function query(before) {
    const parameters = new URLSearchParams({ limit: String(PAGE) });
    const { type, task, text } = filters;
    if (before) parameters.set("before", String(before));
    if (type.value) parameters.set("type", type.value === QUIET ? "-Progressed" : type.value);
    if (task.value) parameters.set("task", task.value);
    if (text.value.trim()) parameters.set("text", text.value.trim());
    return `${path}/events?${parameters}`;
  }

  /** @param {number | null} before */
  async function load(before = null) {
    const request = ++requests;
    if (!before) late = [];
    try {
      /** @type {EventList} */
      const answer = await get(snapshot ? `${path}/events` : query(before));
      if (request !== requests) return;
      if (!before) list.replaceChildren();
      list.append(...(snapshot ? answer.events.filter(passes) : answer.events).map(line));
      oldest = answer.next ?? answer.events.at(-1)?.id ?? oldest;
      older.hidden = !answer.more;
      setText(empty, list.children.length || answer.more ? "" : "No events.");
      add(late ?? []);
      late = null;
    } catch (error) {
      if (request === requests) setText(empty, messageOf(error));
    }
  }

  /** Whether an event passes the filters. @param {RunEvent} event */
  function passes(event) {
    const { type, task, text } = filters;
    const word = text.value.trim().toLowerCase();
    const kind = type.value === QUIET ? event.type !== "Progressed" : !type.value || event.type === type.value;
    return (
      kind &&
      (!task.value || event.task === task.value) &&
      (!word || JSON.stringify(event).toLowerCase().includes(word))
    );
  }

  /** @param {RunEvent[]} events */
  function add(events) {
    const newest = list.firstElementChild instanceof HTMLElement ? Number(list.firstElementChild.dataset.key) : 0;
    const found = events.filter((event) => event.id > newest && passes(event)).sort((a, b) => b.id - a.id);
    if (!found.length) return;
    list.prepend(...found.map(line));
    setText(empty, "");
    while (list.children.length > KEPT) list.lastElementChild?.remove();
  }

  const reload = throttled(() => load(), 300);
  for (const filter of Object.values(filters)) filter.addEventListener("input", reload);
  older.addEventListener("click", () => load(oldest));

  return {
    refresh: () => load(),
    /** @param {RunEvent[]} events */
    add(events) {
      late?.push(...events);
      add(events);
    },
    /** @param {RunPage} run */
    update(run) {
      const tasks = run.summary.tasks.map((task) => task.name);
      const { value } = filters.task;
      replaceIfChanged(filters.task, tasks, () => [
        option("", "all"),
        ...tasks.map((task) => option(task, taskLabel(task))),
      ]);
      filters.task.value = value;
    },
  };
}
