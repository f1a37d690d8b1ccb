// What is selected on the map or in the table: a camera with its gradient scores, or a block with its actions.

/** @import { PlanCamera, RunPage } from "../shared/messages.js" */
/** @import { ActionButtons } from "./actions.js" */
/** @import { PlanMap } from "./map.js" */
/** @import { Row } from "./rows.js" */
/** @import { Choose } from "./run.js" */
import { get, messageOf } from "../shared/api.js";
import { bar, byId, el, pill, replaceIfChanged } from "../shared/dom.js";
import { bytes, count, duration, fixed, percent, short, significant, taskLabel } from "../shared/format.js";
import { lastError } from "./rows.js";

const SCORES = 24; // bars drawn for one camera; of the rest only the number is shown
const REASONS = {
  geometry: "it is in this block",
  gradient: "its gradients here are close to its strongest",
  both: "it is in this block, and its gradients are strong here",
};

/** @param {PlanCamera} camera @param {Choose} choose */
function cameraPanel(camera, choose) {
  const most = Math.max(...camera.scores, 0);
  const order = camera.scores.map((score, block) => ({ score, block, reason: camera.assigned[block] }));
  order.sort((a, b) => Number(Boolean(b.reason)) - Number(Boolean(a.reason)) || b.score - a.score);
  const rows = order.slice(0, SCORES).map(({ score, block, reason }) => {
    const share = most > 0 ? score / most : 0;
    const name = el("button", { type: "button", class: "row-name", on: { click: () => choose.block(block) } }, `Block ${block}`);
    const meter = bar(share, `score of block ${block} relative to the largest`);
    return el("li", { class: reason ? "serves" : null }, name, meter, el("span", { class: "number", title: String(score) }, percent(share)), el("span", { class: "why" }, reason ? `trains it: ${REASONS[reason]}` : "not trained"));
  });
  const rest = order.length - rows.length;
  return [
    el("h3", {}, camera.name),
    el("p", { class: "muted small" }, `In block ${camera.block}. Gradient scores, as shares of its largest (${significant(most)}):`),
    el("ul", { class: "scores" }, rows),
    rest > 0 && el("p", { class: "muted small" }, `${count(rest)} more blocks have lower scores.`),
  ];
}

/** The numbers of a block, which change with every iteration. @param {Row} row */
function blockNumbers(row) {
  const busy = row.status === "running" || row.status === "pausing";
  const error = lastError(row);
  const numbers = [
    ["Iteration", row.iterations ? `${count(row.iteration ?? 0)} of ${count(row.iterations)}` : ""],
    ["Speed", busy && row.rate ? `${fixed(row.rate, 1)} it/s` : ""],
    ["ETA", duration(row.eta)],
    ["Loss", significant(row.loss)],
    ["PSNR, training", fixed(row.psnr)],
    ["Gaussians", short(row.gaussians ?? row.plan?.gaussians)],
    ["Cameras", row.plan ? count(row.plan.cameras) : ""],
    ["Memory", bytes(row.memory)],
    ["Checkpoint", row.checkpoint ? `iteration ${count(row.checkpoint)}` : ""],
    ["Node", [row.node, row.device].filter(Boolean).join(", ")],
    ["Retries", row.retries ? count(row.retries) : ""],
  ].filter(([, value]) => value && value !== "–");
  return [
    el("div", { class: "panel-title" }, el("h3", {}, taskLabel(row.name)), pill(row.status)),
    row.kept && el("p", { class: "muted small" }, "Not trained: it is empty or no camera is assigned to it, so it keeps its Stage I Gaussians."),
    el("dl", { class: "numbers" }, numbers.map(([label, value]) => el("div", {}, el("dt", {}, label), el("dd", {}, value)))),
    error && el("p", { class: "notice error" }, error),
  ];
}

/** Its buttons. They are replaced only when they change: a button that is replaced while pressed does nothing. @param {Row} row @param {Choose} choose @param {ActionButtons} acts */
function blockButtons(row, choose, acts) {
  const shows = [
    el("button", { type: "button", on: { click: () => choose.curve(row.name) } }, "Curves"),
    el("button", { type: "button", on: { click: () => choose.preview(row.name) } }, "Views"),
    acts.viewer(row.name),
  ];
  const block = row.block >= 0;
  return [el("div", { class: "row" }, shows), block && el("div", { class: "row" }, acts.ofBlock(row)), block && acts.whyNot(row)];
}

/**
 * @param {string} path of the run below /api
 * @param {Choose} choose
 * @param {ActionButtons} acts
 * @param {PlanMap} map
 */
export function selection(path, choose, acts, map) {
  const [panel, input] = [byId("selected"), byId("camera", HTMLInputElement)];
  /** @type {{block?: number, camera?: PlanCamera}} */
  let chosen = {};
  /** @type {Row[]} */
  let rows = [];
  const parts = [el("div", { class: "part" }), el("div", { class: "part" })];

  function show() {
    const { block, camera } = chosen;
    if (block === undefined && !camera) return;
    const row = rows.find((one) => one.block === block);
    replaceIfChanged(parts[0], [chosen, row], () => (row ? blockNumbers(row) : camera ? cameraPanel(camera, choose) : []));
    replaceIfChanged(parts[1], [chosen, row?.status, acts.key()], () => (row ? blockButtons(row, choose, acts) : []));
    if (parts[0].parentElement !== panel) panel.replaceChildren(...parts);
  }

  input.addEventListener("change", () => {
    const name = input.value.trim();
    const found = map.cameras().find((camera) => camera.name === name);
    if (found) choose.camera(found.row);
    else if (name) panel.replaceChildren(el("p", { class: "empty" }, "No training camera has this name."));
  });

  return {
    /** @param {number} row of the scene */
    async camera(row) {
      try {
        /** @type {PlanCamera} */
        const camera = await get(`${path}/camera/${row}`);
        chosen = { camera };
        input.value = camera.name;
        show();
      } catch (error) {
        panel.replaceChildren(el("p", { class: "notice error" }, messageOf(error)));
      }
    },
    /** @param {number} block */
    block(block) {
      chosen = { block };
      input.value = "";
      show();
    },
    mapped() {
      byId("camera-names").replaceChildren(...map.cameras().map(({ name }) => el("option", { value: name })));
    },
    /** @param {RunPage} run @param {Row[]} current */
    update(run, current) {
      rows = current;
      show();
      const notices = run.summary.notices.slice(-6);
      const list = () => notices.map(({ task, message }) => el("li", {}, el("b", {}, taskLabel(task)), " ", message));
      replaceIfChanged(byId("notices"), notices, () => (notices.length ? [el("h3", {}, "Notices"), el("ul", { class: "noticed" }, list())] : []));
    },
  };
}
