// What is chosen on the map or in the table: a camera with its gradient scores, or a block and what can be done.

import { get } from "./api.js";
import { byId, el, pill, setText } from "./dom.js";
import { blockTask, bytes, count, duration, fixed, percent, short, significant, taskLabel } from "./format.js";

const SCORES = 24; // bars drawn for one camera; the rest is told
const REASONS = {
  geometry: "it stands in this block",
  gradient: "its gradients here are close to its strongest",
  both: "it stands in this block, and its gradients are strong here",
};

function numbers(pairs) {
  return el("dl", { class: "numbers" }, pairs.filter(([, value]) => value && value !== "–").map(([label, value]) => el("div", {}, el("dt", {}, label), el("dd", {}, value))));
}

function cameraPanel(camera, choose) {
  const most = Math.max(...camera.scores, 0);
  const order = camera.scores.map((score, block) => ({ score, block, reason: camera.assigned[block] }));
  order.sort((a, b) => Boolean(b.reason) - Boolean(a.reason) || b.score - a.score);
  const rows = order.slice(0, SCORES).map(({ score, block, reason }) => {
    const share = most > 0 ? score / most : 0;
    const name = el("button", { type: "button", class: "row-name", on: { click: () => choose.block(block) } }, `Block ${block}`);
    const meter = el("progress", { max: 1, value: share, "aria-label": `score of block ${block} beside the largest` });
    return el("li", { class: reason ? "serves" : null }, name, meter, el("span", { class: "number", title: String(score) }, percent(share)), el("span", { class: "why" }, reason ? `trains it: ${REASONS[reason]}` : "not trained"));
  });
  const rest = order.length - rows.length;
  return [
    el("h3", {}, camera.name),
    el("p", { class: "muted small" }, `Stands in block ${camera.block}. Gradient scores, as shares of its largest (${significant(most)}):`),
    el("ul", { class: "scores" }, rows),
    rest > 0 && el("p", { class: "muted small" }, `${count(rest)} more blocks score less.`),
  ];
}

/** The numbers of a block: new with every iteration. */
function blockNumbers(row) {
  const task = row.name;
  const last = row.reasons?.at(-1);
  const busy = row.status === "running" || row.status === "pausing";
  return [
    el("div", { class: "panel-title" }, el("h3", {}, taskLabel(task)), pill(row.status)),
    row.kept && el("p", { class: "muted small" }, "Not trained: it is empty or no camera is assigned to it, so it keeps its Stage I Gaussians."),
    numbers([
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
    ]),
    last && el("p", { class: "notice error" }, last),
  ];
}

/** Its buttons. They stay while they mean the same: one that is replaced while it is pressed does nothing. */
function blockButtons(row, choose, acts) {
  const shows = [
    el("button", { type: "button", on: { click: () => choose.curve(row.name) } }, "Curves"),
    el("button", { type: "button", on: { click: () => choose.preview(row.name) } }, "Views"),
    acts.viewer(row.name, "3D view"),
  ];
  const block = row.block >= 0;
  return [el("div", { class: "row" }, shows), block && el("div", { class: "row" }, acts.ofBlock(row)), block && acts.whyNot(row)];
}

export function selection(path, choose, acts, map) {
  let chosen = null; // {block} or {camera}
  let rows = [];
  const parts = [el("div", { class: "part" }), el("div", { class: "part" })];

  /** Fills a part of the panel, unless it already shows what this key stands for. What has the focus keeps it. */
  function fill(part, key, content) {
    const text = JSON.stringify(key);
    if (part.dataset.key === text) return;
    part.dataset.key = text;
    const focused = part.contains(document.activeElement) ? document.activeElement.textContent : null;
    part.replaceChildren(...content().filter(Boolean));
    if (focused) [...part.querySelectorAll("button")].find((button) => button.textContent === focused)?.focus();
  }

  function show() {
    if (!chosen) return;
    const row = "block" in chosen ? rows.find((one) => one.block === chosen.block) : null;
    fill(parts[0], [chosen, row], () => (row ? blockNumbers(row) : chosen.camera ? cameraPanel(chosen.camera, choose) : []));
    fill(parts[1], [chosen, row?.status, acts.key()], () => (row ? blockButtons(row, choose, acts) : []));
    if (parts[0].parentElement !== byId("selected")) byId("selected").replaceChildren(...parts);
  }

  async function camera(row) {
    try {
      chosen = { camera: await get(`${path}/camera/${row}`) };
      byId("camera").value = chosen.camera.name;
      show();
    } catch (error) {
      byId("selected").replaceChildren(el("p", { class: "notice error" }, error.message));
    }
  }

  byId("camera").addEventListener("change", (event) => {
    const found = map.cameras().find(({ name }) => name === event.target.value.trim());
    if (found) choose.camera(found.row);
    else if (event.target.value.trim()) byId("selected").replaceChildren(el("p", { class: "empty" }, "No training camera has this name."));
  });

  return {
    camera,
    block(block) {
      chosen = { block };
      byId("camera").value = "";
      show();
    },
    mapped() {
      byId("camera-names").replaceChildren(...map.cameras().map(({ name }) => el("option", { value: name })));
    },
    update(run, tasks) {
      rows = tasks;
      show();
      const notices = run.summary.notices.slice(-6);
      const key = JSON.stringify(notices);
      if (byId("notices").dataset.key === key) return;
      byId("notices").dataset.key = key;
      const list = notices.map(({ task, message }) => el("li", {}, el("b", {}, taskLabel(task)), " ", message));
      byId("notices").replaceChildren(...(list.length ? [el("h3", {}, "Notices"), el("ul", { class: "noticed" }, list)] : []));
    },
  };
}
