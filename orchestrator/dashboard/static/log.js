// What has happened, newest first, with filters. Progress is left out unless it is asked for: there is so much of it.

import { get } from "./api.js";
import { byId, el, setText, throttled } from "./dom.js";
import { bytes, clock, count, decibel, duration, fixed, significant, taskLabel } from "./format.js";

const PAGE = 100;
const KEPT = 2000; // events in the page at most
const QUIET = "quiet";
const TYPES = {
  RunBegan: ["Driver", (e) => `${e.resumed ? "took the run over" : "began"} on ${e.host}`],
  TaskStarted: ["Started", (e) => `attempt ${e.attempt}${e.iteration ? ` from iteration ${count(e.iteration)}` : ""} on ${e.node}, ${e.device}, ${e.threads} threads`],
  Progressed: ["Progress", (e) => `${count(e.iteration)} of ${count(e.iterations)}, ${fixed(e.rate, 1)} it/s${e.loss === null ? "" : `, loss ${significant(e.loss)}`}`],
  PreviewSaved: ["Picture", (e) => `${e.view} at iteration ${count(e.iteration)}`],
  Noticed: ["Notice", (e) => e.message],
  CheckpointSaved: ["Checkpoint", (e) => `iteration ${count(e.iteration)}, ${bytes(e.size)}`],
  ModelSaved: ["Model", (e) => `${count(e.gaussians)} Gaussians, ${bytes(e.size)}, after ${duration(e.seconds)}`],
  ScoresSaved: ["Scores", (e) => `${count(e.cameras)} cameras`],
  PlanSaved: ["Plan", (e) => `${count(e.blocks.length)} blocks`],
  TaskFailed: ["Failed", (e) => `attempt ${e.attempt}: ${e.reason}; ${e.then || (e.final ? "given up" : "trying again")}`],
  Merged: ["Merged", (e) => `${count(e.gaussians)} Gaussians, ${count(e.sky)} of them sky, ${bytes(e.size)}`],
  ViewEvaluated: ["View", (e) => `${e.view}: PSNR ${decibel(e.metrics.psnr)}, SSIM ${fixed(e.metrics.ssim, 4)}`],
  EvaluationSaved: ["Metrics", (e) => `PSNR ${decibel(e.metrics.psnr)}, SSIM ${fixed(e.metrics.ssim, 4)}`],
  Transferred: ["Moved", (e) => `${bytes(e.received)} received, ${bytes(e.sent)} sent`],
  StopRequested: ["Stop asked", (e) => `${count(e.tasks)} tasks save a checkpoint first`],
  PauseRequested: ["Pause asked", () => "saves a checkpoint and waits"],
  UnpauseRequested: ["Go on asked", () => "may go on"],
  RetryRequested: ["Retry asked", () => "has all its attempts again"],
  TaskYielded: ["Yielded", () => "ended early, after a checkpoint"],
  RunEnded: ["Ended", (e) => [e.outcome, e.reason].filter(Boolean).join(": ")],
};

function line(event) {
  const [label, describe] = TYPES[event.type] ?? [event.type, () => ""];
  const tone = event.type === "TaskFailed" || event.outcome === "failed" ? "failed" : event.type === "Noticed" ? "paused" : event.type.endsWith("Saved") || event.outcome === "done" ? "done" : "waiting";
  const time = el("time", { datetime: new Date(event.time * 1000).toISOString() }, clock(event.time));
  const detail = event.detail && el("details", {}, el("summary", {}, "Traceback"), el("pre", { tabindex: 0 }, event.detail));
  return el("li", { "data-key": event.id }, time, el("span", { class: "kind", "data-status": tone }, label), el("span", { class: "task" }, taskLabel(event.task)), el("span", { class: "what" }, describe(event), detail));
}

export function log(path) {
  const list = byId("events");
  const filters = { type: byId("log-type"), task: byId("log-task"), text: byId("log-text") };
  let oldest = null;
  let asked = 0; // so that a slow answer does not replace a later one

  filters.type.append(el("option", { value: QUIET }, "all but progress"), el("option", { value: "" }, "all"), ...Object.entries(TYPES).map(([type, [label]]) => el("option", { value: type }, label)));
  filters.task.append(el("option", { value: "" }, "all"));

  function query(extra) {
    const words = new URLSearchParams({ limit: PAGE, ...extra });
    if (filters.type.value === QUIET) words.set("type", "-Progressed");
    else if (filters.type.value) words.set("type", filters.type.value);
    if (filters.task.value) words.set("task", filters.task.value);
    if (filters.text.value.trim()) words.set("text", filters.text.value.trim());
    return `${path}/events?${words}`;
  }

  async function load(before = null) {
    const mine = ++asked;
    const answer = await get(query(before ? { before } : {})).catch((error) => ({ error }));
    if (mine !== asked) return;
    if (answer.error) return setText(byId("log-empty"), answer.error.message);
    if (!before) list.replaceChildren();
    list.append(...answer.events.map(line));
    oldest = answer.next ?? answer.events.at(-1)?.id ?? oldest;
    byId("older").hidden = !answer.more;
    setText(byId("log-empty"), list.children.length || answer.more ? "" : "Nothing here.");
  }

  function wanted(event) {
    const { type, task, text } = filters;
    const word = text.value.trim().toLowerCase();
    const kind = type.value === QUIET ? event.type !== "Progressed" : !type.value || event.type === type.value;
    return kind && (!task.value || event.task === task.value) && (!word || JSON.stringify(event).toLowerCase().includes(word));
  }

  const reload = throttled(() => load(), 300);
  for (const filter of Object.values(filters)) filter.addEventListener("input", reload);
  byId("older").addEventListener("click", () => load(oldest));

  return {
    refresh: () => load(),
    add(events) {
      const known = Number(list.firstElementChild?.dataset.key ?? 0);
      const news = events.filter((event) => event.id > known && wanted(event)).sort((a, b) => b.id - a.id);
      if (!news.length) return;
      list.prepend(...news.map(line));
      setText(byId("log-empty"), "");
      while (list.children.length > KEPT) list.lastElementChild.remove();
    },
    update(run) {
      const tasks = run.summary.tasks.map((task) => task.name);
      const key = tasks.join();
      if (filters.task.dataset.key === key) return;
      filters.task.dataset.key = key;
      const { value } = filters.task;
      filters.task.replaceChildren(el("option", { value: "" }, "all"), ...tasks.map((task) => el("option", { value: task }, taskLabel(task))));
      filters.task.value = value;
    },
  };
}
