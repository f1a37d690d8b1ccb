// The rows of the block table: Stage I and all blocks of the plan, and the status of each block on the map.

/** @import { BlockPlan, RunPage, Status, TaskView } from "../shared/messages.js" */
import { blockTask } from "panolog/shared/format.js";

/**
 * A row: a task, which has few fields before it starts. `block` is -1 for all but blocks, `place` that in the order of the stages, `kept` is a block that is not trained.
 * @typedef {Partial<Omit<TaskView, "status">> & {name: string, status: Status | "kept" | "pausing", share: number, block: number, place: number, plan?: BlockPlan, kept: boolean, device: string}} Row
 */

/** The statuses of a block; "kept" is not trained. */
export const BLOCK_STATUSES = ["waiting", "running", "paused", "done", "failed", "kept"];

/** Statuses by which people read them, where that is another word. @type {Record<string, string>} */
export const STATES = { kept: "as Stage I left it" };

/**
 * The status of each block and its share done, 0 to 1.
 * @param {RunPage} run
 * @returns {Map<number, [string, number]>}
 */
export function blockStatuses({ summary }) {
  const tasks = new Map(summary.tasks.map((task) => [task.name, task]));
  return new Map(
    summary.blocks.map(({ block, train }) => {
      const task = tasks.get(blockTask(block));
      return [block, !train ? ["kept", 1] : task ? [task.status, task.share] : ["waiting", 0]];
    }),
  );
}

/** @param {RunPage} run @returns {Row[]} */
export function trainingRows({ summary, nodes, paused }) {
  const devices = new Map(nodes.map((node) => [node.node, node.gpus.join(", ") || node.device]));
  const tasks = new Map(summary.tasks.map((task) => [task.name, task]));
  /** @param {string} name @param {number} block @param {BlockPlan} [plan] @returns {Row} */
  const row = (name, block, plan) => {
    const task = tasks.get(name) ?? { name, status: "waiting", share: 0, retries: 0, reasons: [] };
    const kept = plan !== undefined && !plan.train;
    const status = kept ? "kept" : paused.includes(block) && task.status === "running" ? "pausing" : task.status;
    const device = ("node" in task && task.node && devices.get(task.node)) || "";
    return { ...task, block, place: 0, plan, kept, device, status, share: kept ? 1 : task.share };
  };
  /** @param {string} stage */
  const others = (stage) =>
    summary.tasks.filter(({ name }) => name.startsWith(`${stage}/`)).map(({ name }) => row(name, -1));
  const blocks = summary.blocks.map((plan) => row(blockTask(plan.block), plan.block, plan));
  const rows = [...others("district"), row("coarse", -1), ...blocks, ...others("round"), ...others("repair")];
  rows.forEach((each, place) => {
    each.place = place;
  });
  return rows;
}

/** The last error of a task. @param {Row} row */
export const lastError = (row) => row.reasons?.at(-1) ?? "";
