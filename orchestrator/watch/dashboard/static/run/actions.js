// What can be done with a run or a block: each action requires a confirmation, and states why it is not possible.

/** @import { Actions, NodeView, RunPage } from "../shared/messages.js" */
/** @import { Row } from "./rows.js" */
import { messageOf, post } from "panolog/shared/api.js";
import { confirm } from "panolog/shared/confirm.js";
import { byId, el, replaceIfChanged, setMessage } from "panolog/shared/dom.js";
import { taskLabel } from "panolog/shared/format.js";

/** @typedef {"stop" | "resume" | "pause" | "unpause" | "retry" | "release"} Action */

/** Title, text and button of each confirmation; {} is the block, the blocks or the machine. @type {Record<Action, [string, string, string]>} */
const TEXTS = {
  stop: [
    "Stop the run?",
    "Every task that trains saves a checkpoint first. The run can be resumed from there.",
    "Stop",
  ],
  resume: ["Resume the run?", "A new driver starts on this machine and resumes from the last checkpoints.", "Resume"],
  pause: ["Pause {}?", "It saves a checkpoint and waits. The others continue; the merge waits for it.", "Pause"],
  unpause: ["Resume {}?", "From the last checkpoint, when a worker is free.", "Resume"],
  release: [
    "Release {}?",
    "It gets the next task that waits. If tasks fail there again, it goes back into quarantine.",
    "Release",
  ],
  retry: ["Retry {}?", "It gets all its attempts again and resumes from its last checkpoint.", "Retry"],
};
/** The states of a block in which an action is possible. @type {Partial<Record<Action, string[]>>} */
const POSSIBLE = {
  pause: ["waiting", "running"],
  unpause: ["paused", "pausing"],
  retry: ["failed", "waiting", "running"],
};

/** The files that are made of a model on request: kind, name, and what for. */
const FILES = [
  ["sog", "SOG", "for SuperSplat, PlayCanvas, Spark: the smallest file"],
  ["spz", "SPZ", "for Scaniverse, Spark, Babylon.js; without the sky"],
  ["ply", "Upright PLY", "for every other viewer: y down, as they expect it"],
  ["html", "Page", "the 3D view as one file, which opens without a server"],
];

const RAW = "for training and GIS: the run's own axes, on its side in viewers";

/** @param {number[]} blocks one at least */
const blocksLabel = (blocks) => (blocks.length > 1 ? `${blocks.length} blocks` : taskLabel(`block/${blocks[0]}`));

/** @typedef {ReturnType<typeof actions>} ActionButtons */

/** @param {string} path of the run below /api */
export function actions(path) {
  /** @type {Actions} */
  let given = { allowed: false, why: "", available: [], failed: null };

  /**
   * A button. One that is not possible stays in the tab order, so that its reason can be read.
   * @param {Action} action
   * @param {number[]} blocks none for an action on the run or a machine
   * @param {string} why it is not possible; empty if it is
   * @param {NodeView["quarantine"]} machine
   */
  function button(action, blocks, why, machine = null) {
    const [title, text, label] = TEXTS[action];
    const name = machine ? machine.host : blocks.length ? blocksLabel(blocks) : "";
    const texts = /** @type {[string, string, string]} */ ([title.replace("{}", name), text, label]);
    const stop = action === "stop";
    const node = machine ? machine.node : null;
    const send = async () => {
      for (const block of blocks.length ? blocks : [null]) await post(`${path}/actions`, { action, block, node });
    };
    const click = () => why || confirm(texts, stop, send);
    return el(
      "button",
      {
        type: "button",
        "data-action": action,
        class: stop && !why ? "danger" : null,
        "aria-disabled": why ? "true" : null,
        title: why || null,
        on: { click },
      },
      label,
    );
  }

  /** Resumes all blocks that are paused. @param {number[]} blocks */
  function unpause(blocks) {
    const made = button("unpause", blocks, refusal("unpause"));
    made.append(` ${blocksLabel(blocks)}`);
    return made;
  }

  /** Why an action is not possible; empty if it is. @param {Action} action @param {Row} [row] */
  const refusal = (action, row) => {
    if (!given.available.includes(action))
      return given.why || (action === "resume" ? "the run is running" : "no driver is at work on the run");
    return !row || POSSIBLE[action]?.includes(row.status) ? "" : `the block is ${row.status}`;
  };

  /**
   * Opens the 3D view of a task, or of the run. The window comes first: after a wait a browser would block it.
   * @param {string | null} task
   * @param {string | null} camera where it begins
   * @param {HTMLElement} button
   */
  async function open(task, camera, button) {
    const page = window.open("", "_blank");
    page?.document.body.append("Making the 3D view …");
    button.setAttribute("aria-busy", "true");
    try {
      const { url } = await post(`${path}/viewer`, { task, camera });
      (page ?? window).location.assign(url);
    } catch (error) {
      page?.close();
      setMessage(byId("why"), `No 3D view: ${messageOf(error)}`);
      byId("why").scrollIntoView({ block: "center" });
    } finally {
      button.removeAttribute("aria-busy");
    }
  }

  /** @param {string | null} task @param {string | null} camera */
  const viewer = (task, camera = null) => {
    const button = el(
      "button",
      { type: "button", on: { click: () => open(task, camera, button) } },
      camera ? "Open in 3D from here" : "3D view",
    );
    return button;
  };

  /** @param {string} file @param {string} label */
  const link = (file, label) => {
    const page = file.endsWith(".html");
    return el(
      "a",
      {
        class: "button",
        href: `/api/${path}/${file}`,
        download: page ? null : "",
        target: page ? "_blank" : null,
        rel: "noopener",
      },
      label,
    );
  };

  /** Makes a file of the model and saves it. @param {string} kind @param {HTMLElement} button */
  async function save(kind, button) {
    button.setAttribute("aria-busy", "true");
    setMessage(byId("why"), "Making the file: this takes seconds, or minutes of a large model.");
    try {
      const { url } = await post(`${path}/downloads`, { kind });
      setMessage(byId("why"), "");
      location.assign(url);
    } catch (error) {
      setMessage(byId("why"), `No file: ${messageOf(error)}`);
    } finally {
      button.removeAttribute("aria-busy");
    }
  }

  /** The model in all formats, those that are made on request first. */
  function downloads() {
    const made = FILES.map(([kind, name, use]) => {
      const button = el("button", { type: "button", on: { click: () => save(kind, button) } }, name);
      return el("li", {}, button, el("span", { class: "muted small" }, use));
    });
    const raw = el("li", {}, link("point_cloud.ply", "Raw PLY"), el("span", { class: "muted small" }, RAW));
    return el("details", { class: "menu" }, el("summary", { class: "button" }, "Download"), el("ul", {}, ...made, raw));
  }

  return {
    viewer,
    key: () => JSON.stringify(given),
    /** The buttons of a block. @param {Row} row */
    ofBlock(row) {
      const pause = row.status === "paused" || row.status === "pausing" ? "unpause" : "pause";
      const blocks = row.block === null ? [] : [row.block];
      return [button(pause, blocks, refusal(pause, row)), button("retry", blocks, refusal("retry", row))];
    },
    /** The button of a machine in quarantine. @param {NonNullable<NodeView["quarantine"]>} machine */
    ofMachine: (machine) => button("release", [], refusal("release"), machine),
    /** A line for touch screens, which show no tooltips, where no action is possible. @param {Row} row */
    whyNot(row) {
      const whys = /** @type {const} */ (["pause", "unpause", "retry"]).map((action) => refusal(action, row));
      return whys.every(Boolean) && el("p", { class: "muted small" }, `Not possible now: ${whys[0]}.`);
    },
    /** @param {RunPage} run */
    update({ actions: current, result, paused, summary: { status } }) {
      given = current;
      replaceIfChanged(byId("actions"), [given, result, status, paused], () => {
        setMessage(
          byId("why"),
          status === "done" || given.allowed ? (given.failed ?? "") : `Actions are disabled: ${given.why}`,
        );
        return [
          status === "running" && paused.length > 0 && unpause(paused),
          status === "running"
            ? button("stop", [], refusal("stop"))
            : status !== "done" && button("resume", [], refusal("resume")),
          result.in_3d && viewer(null),
          result.model && downloads(),
          result.report && link("report.html", "Report"),
        ];
      });
    },
  };
}
