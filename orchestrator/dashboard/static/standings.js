// How each block stands. Mirrors orchestrator/views/map.py, which says the same to the report.

import { blockTask } from "./format.js";

export const STANDINGS = ["waiting", "running", "paused", "done", "failed", "kept"];

/** Map of block → [standing, share done]. */
export function standingsOf(run) {
  const tasks = new Map(run.summary.tasks.map((task) => [task.name, task]));
  return new Map(run.summary.blocks.map((plan) => {
    if (!plan.train) return [plan.block, ["kept", 1]];
    const task = tasks.get(blockTask(plan.block));
    if (!task) return [plan.block, ["waiting", 0]];
    const share = task.iterations ? (task.iteration ?? 0) / task.iterations : 0;
    return [plan.block, [task.status, task.status === "done" ? 1 : share]];
  }));
}

/** Stage I and all blocks of the plan, as rows of the table. */
export function trainingTasks(run) {
  const nodes = new Map((run.nodes ?? []).map((node) => [node.node, node]));
  const paused = new Set(run.paused ?? []);
  const plans = new Map(run.summary.blocks.map((plan) => [plan.block, plan]));
  const rows = [];
  const row = (task, block) => {
    const node = nodes.get(task.node);
    const plan = plans.get(block);
    const kept = plan !== undefined && !plan.train;
    const pausing = paused.has(block) && task.status === "running";
    rows.push({ ...task, block, plan, kept, device: node?.gpus?.join(", ") || node?.device || "", status: kept ? "kept" : pausing ? "pausing" : task.status });
  };
  const tasks = new Map(run.summary.tasks.map((task) => [task.name, task]));
  const nothing = { status: "waiting", retries: 0, reasons: [] };
  row(tasks.get("coarse") ?? { ...nothing, name: "coarse" }, -1);
  for (const { block } of run.summary.blocks) {
    const name = blockTask(block);
    row(tasks.get(name) ?? { ...nothing, name }, block);
  }
  return rows;
}
