// What is selected on the map or in the table: a camera with its gradient scores, or a block with its actions.

import { lastError } from "panolog/run/rows.js";
/** @import { BlockCameras, CameraView, PreviewList, RunPage, SavedPreview } from "../shared/messages.js" */
/** @import { ActionButtons } from "./actions.js" */
/** @import { PlanMap } from "./map.js" */
/** @import { Row } from "./rows.js" */
/** @import { Choose } from "./run.js" */
import { get, messageOf, snapshot, urlOf } from "panolog/shared/api.js";
import { bar, byId, el, pill, replaceIfChanged } from "panolog/shared/dom.js";
import {
  bytes,
  count,
  duration,
  fixed,
  moment,
  percent,
  short,
  significant,
  taskLabel,
} from "panolog/shared/format.js";

const SCORES = 24; // bars drawn for one camera; of the rest only the number is shown
const REASONS = {
  geometry: "it is in this block",
  gradient: "its gradients here are close to its strongest",
  both: "it is in this block, and its gradients are strong here",
};

/** What chose a camera for a block. @type {Record<string, string>} */
const CRITERIA = { geometry: "geometry", gradient: "gradient", both: "geometry and gradient" };
const NOTICES = [6, 2_000]; // the latest that are shown, and those that can be
const OPEN = 12; // cameras of a block up to which their list is open

/**
 * The picture of a camera, and the latest renders of it. A preview has the render in its upper half.
 * @param {string} path
 * @param {CameraView} camera
 * @param {SavedPreview[]} previews
 * @param {Choose} choose
 */
function cameraPictures(path, camera, previews, choose) {
  const broken = el("figcaption", {}, "Panorama");
  const panorama = el("img", {
    alt: `the panorama ${camera.name}`,
    src: camera.no_picture ? null : urlOf(`${path}/camera/${camera.row}/panorama`),
    on: {
      error: () => {
        panorama.remove();
        broken.textContent = "Its picture cannot be decoded.";
      },
    },
  });
  const renders = previews
    .filter(({ view }) => view === camera.name)
    .map(({ event, task, iteration }) => {
      const label = `${taskLabel(task)}, ${moment(iteration)}`;
      const image = el("img", { alt: "", src: urlOf(`${path}/previews/${event}`), loading: "lazy" });
      return el(
        "figure",
        {},
        el(
          "button",
          { type: "button", class: "picture", on: { click: () => choose.preview(task) } },
          image,
          el("span", {}, label),
        ),
      );
    });
  return el(
    "div",
    { class: "pictures" },
    camera.no_picture
      ? el("p", { class: "muted small" }, `No picture: ${camera.no_picture}.`)
      : el("figure", {}, panorama, broken),
    renders,
  );
}

/** The cameras that train a block. @param {BlockCameras} block @param {Choose} choose */
function cameraList({ cameras }, choose) {
  const groups = Object.groupBy(cameras, ({ reason }) => reason);
  const tally = Object.entries(groups)
    .map(([reason, some]) => `${count(some?.length)} by ${CRITERIA[reason]}`)
    .join(", ");
  const items = cameras.map(({ row, name, reason }) =>
    el(
      "li",
      {},
      el("button", { type: "button", class: "row-name", on: { click: () => choose.camera(row) } }, name),
      el("span", { class: "muted" }, CRITERIA[reason]),
    ),
  );
  if (!items.length) return el("p", { class: "muted small" }, "No camera trains it.");
  const summary = el("summary", {}, `${count(cameras.length)} camera${cameras.length > 1 ? "s" : ""}: ${tally}`);
  return el("details", { open: items.length <= OPEN }, summary, el("ul", { class: "cameras" }, items));
}

/** @param {CameraView} camera @param {Choose} choose */
function cameraPanel(camera, choose) {
  if (!camera.scores.length)
    return [el("p", { class: "muted small" }, "Which blocks it trains is decided after Stage I.")];
  const most = Math.max(...camera.scores, 0);
  const order = camera.scores.map((score, block) => ({ score, block, reason: camera.assigned[block] }));
  order.sort((a, b) => Number(Boolean(b.reason)) - Number(Boolean(a.reason)) || b.score - a.score);
  const rows = order.slice(0, SCORES).map(({ score, block, reason }) => {
    const share = most > 0 ? score / most : 0;
    const name = el(
      "button",
      { type: "button", class: "row-name", on: { click: () => choose.block(block) } },
      `Block ${block}`,
    );
    const meter = bar(share, `score of block ${block} relative to the largest`);
    return el(
      "li",
      { class: reason ? "serves" : null },
      name,
      meter,
      el("span", { class: "number", title: String(score) }, percent(share)),
      el("span", { class: "why" }, reason ? `trains it: ${REASONS[reason]}` : "not trained"),
    );
  });
  const rest = order.length - rows.length;
  return [
    el(
      "p",
      { class: "muted small" },
      `In block ${camera.block}. Gradient scores, as shares of its largest (${significant(most)}):`,
    ),
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
    ["Time", duration(row.seconds)],
    ["Loss", significant(row.loss)],
    ["PSNR, training", fixed(row.psnr)],
    ["Gaussians", short(row.gaussians ?? row.plan?.gaussians)],
    ["Of Stage I", row.gaussians && row.plan ? short(row.plan.gaussians) : ""],
    ["Cameras", row.plan ? count(row.plan.cameras) : ""],
    ["Memory", bytes(row.memory)],
    ["Checkpoint", row.checkpoint ? `iteration ${count(row.checkpoint)}` : ""],
    ["Node", [row.node, row.device].filter(Boolean).join(", ")],
    ["Retries", row.retries ? count(row.retries) : ""],
  ].filter(([, value]) => value && value !== "–");
  return [
    el("div", { class: "panel-title" }, el("h3", {}, taskLabel(row.name)), pill(row.status)),
    row.kept &&
      el(
        "p",
        { class: "muted small" },
        "Not trained: it has next to no Gaussians or too few cameras, so it keeps its Stage I Gaussians.",
      ),
    el(
      "dl",
      { class: "numbers" },
      numbers.map(([label, value]) => el("div", {}, el("dt", {}, label), el("dd", {}, value))),
    ),
    error && el("p", { class: "notice error" }, error),
  ];
}

/** Its buttons. They are replaced only when they change: a button that is replaced while pressed does nothing. @param {Row} row @param {Choose} choose @param {ActionButtons} acts */
function blockButtons(row, choose, acts) {
  const shows = [
    el("button", { type: "button", on: { click: () => choose.curve(row.name) } }, "Curves"),
    !snapshot && el("button", { type: "button", on: { click: () => choose.preview(row.name) } }, "Views"),
    !snapshot && acts.viewer(row.name),
  ];
  const block = row.block >= 0 && !snapshot;
  return [
    el("div", { class: "row" }, shows),
    block && el("div", { class: "row" }, acts.ofBlock(row)),
    block && acts.whyNot(row),
  ];
}

/**
 * @param {string} path of the run below /api
 * @param {Choose} choose
 * @param {ActionButtons} acts
 * @param {PlanMap} map
 */
export function selection(path, choose, acts, map) {
  const [panel, input] = [byId("selected"), byId("camera", HTMLInputElement)];
  /** @type {{block?: number, camera?: CameraView, previews?: SavedPreview[], cameras?: BlockCameras}} */
  let chosen = {};
  /** @type {Row[]} */
  let rows = [];
  /** The head, the buttons and the rest: each is replaced only when it has changed. */
  const parts = [el("div", { class: "part" }), el("div", { class: "part" }), el("div", { class: "part" })];

  function show() {
    const { block, camera, previews = [], cameras } = chosen;
    if (block === undefined && !camera) return;
    const row = rows.find((one) => one.block === block);
    const key = [block, camera?.row];
    replaceIfChanged(parts[0], [key, row, previews], () => {
      if (row) return blockNumbers(row);
      return camera ? [el("h3", {}, camera.name), cameraPictures(path, camera, previews, choose)] : [];
    });
    replaceIfChanged(parts[1], [key, row?.status, acts.key()], () => {
      if (row) return blockButtons(row, choose, acts);
      return camera && !snapshot ? [el("div", { class: "row" }, acts.viewer(null, camera.name))] : [];
    });
    replaceIfChanged(parts[2], [key, cameras], () =>
      camera ? cameraPanel(camera, choose) : cameras ? [cameraList(cameras, choose)] : [],
    );
    if (parts[0].parentElement !== panel) panel.replaceChildren(...parts);
  }

  /** The cameras of a block; Stage I has none in particular. @param {number} block */
  async function loadCameras(block) {
    if (block < 0 || !map.cameras().length) return;
    try {
      /** @type {BlockCameras} */
      const cameras = await get(`${path}/block/${block}`);
      if (chosen.block === block) chosen = { block, cameras };
      show();
    } catch (error) {
      if (chosen.block === block) parts[2].replaceChildren(el("p", { class: "notice error" }, messageOf(error)));
    }
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
        /** @type {[CameraView, PreviewList]} */
        const [camera, { previews }] = await Promise.all([get(`${path}/camera/${row}`), get(`${path}/previews`)]);
        chosen = { camera, previews };
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
      loadCameras(block);
    },
    mapped() {
      byId("camera-names").replaceChildren(...map.cameras().map(({ name }) => el("option", { value: name })));
    },
    /** @param {RunPage} run @param {Row[]} current */
    update(run, current) {
      rows = current;
      show();
      const { notices } = run.summary;
      /** @param {typeof notices} some */
      const list = (some) =>
        el(
          "ul",
          { class: "noticed" },
          some.map(({ task, message }) => el("li", {}, el("b", {}, taskLabel(task)), " ", message)),
        );
      const earlier = notices.slice(-NOTICES[1], -NOTICES[0]);
      replaceIfChanged(byId("notices"), notices, () =>
        notices.length
          ? [
              el("h3", {}, "Notices"),
              list(notices.slice(-NOTICES[0])),
              earlier.length > 0 &&
                el("details", {}, el("summary", {}, `${count(earlier.length)} earlier`), list(earlier)),
            ]
          : [],
      );
    },
  };
}
