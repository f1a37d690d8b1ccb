// What can be done with a run or a block: each asks first, and says why where it is not possible.

import { post } from "./api.js";
import { byId, el, setText } from "./dom.js";
import { taskLabel } from "./format.js";

const TEXTS = {
  stop: ["Stop the run?", "Every task that trains saves a checkpoint first. The run can be resumed from there.", "Stop"],
  resume: ["Resume the run?", "A new driver starts on this machine and goes on from the last checkpoints.", "Resume"],
  pause: ["Pause it?", "It saves a checkpoint and waits. The others go on; the merge waits for it.", "Pause"],
  unpause: ["Let it go on?", "It goes on from its last checkpoint as soon as a place is free.", "Go on"],
  retry: ["Try again?", "It gets all its attempts anew and goes on from its last checkpoint.", "Retry"],
};
// In which states of a block an action makes sense.
const SENSE = {
  pause: ["waiting", "running"],
  unpause: ["paused", "pausing"],
  retry: ["failed", "waiting", "running"],
};

/** Asks in the dialog, and does it there, so that what goes wrong is told where it was asked. */
function confirm([title, text, yes], danger, act) {
  const [dialog, button, error] = ["confirm", "confirm-yes", "confirm-error"].map(byId);
  setText(byId("confirm-title"), title);
  setText(byId("confirm-text"), text);
  setText(button, yes);
  setText(error, "");
  button.className = danger ? "danger" : "primary";
  button.onclick = async () => {
    try {
      await act();
      dialog.close();
    } catch (failure) {
      setText(error, failure.message);
    }
  };
  dialog.showModal();
}

export function actions(path) {
  let given = { allowed: false, why: "", available: [] };
  let drawn = "";

  /** A button that is only greyed, not taken out of the keyboard's way, so that everybody can learn why. */
  function button(action, label, block, why) {
    const act = () => post(`${path}/actions`, { action, block });
    const [title, text, yes] = TEXTS[action];
    const whole = block === null ? title : title.replace("it", taskLabel(`block/${block}`)).replace("Try again", `Retry ${taskLabel(`block/${block}`)}`);
    const ask = () => why || confirm([whole, text, yes], action === "stop", act);
    return el("button", { type: "button", "data-action": action, class: action === "stop" && !why ? "danger" : null, "aria-disabled": why ? "true" : null, title: why || null, on: { click: ask } }, label);
  }

  const refusal = (action, row = null) => {
    if (!given.available.includes(action)) return given.why || (action === "resume" ? "the run is going on" : "no driver is at work");
    return row === null || SENSE[action].includes(row.status) ? "" : `the block is ${row.status}`;
  };

  /** Opens the 3D view of a task, or of the run without one. The window comes first: later a browser blocks it. */
  async function open(task, button) {
    const page = window.open("", "_blank");
    page?.document.body.append("Making the 3D view …");
    button.setAttribute("aria-busy", "true");
    try {
      const { url } = await post(`${path}/viewer`, { task });
      if (page) page.location = url;
      else location.assign(url);
    } catch (error) {
      page?.close();
      setText(byId("why"), error.message);
      byId("why").hidden = false;
    } finally {
      button.removeAttribute("aria-busy");
    }
  }

  const viewer = (task, label) => el("button", { type: "button", on: { click: (event) => open(task, event.currentTarget) } }, label);

  function show(run) {
    const { result } = run;
    const status = run.summary.status;
    const link = (there, file, label) => there && el("a", { class: "button", href: `/api/${path}/${file}`, download: file === "report.html" ? null : "", target: file === "report.html" ? "_blank" : null, rel: "noopener" }, label);
    const model = run.summary.tasks.some((task) => task.checkpoint || task.status === "done");
    byId("actions").replaceChildren(...[
      status === "running" ? button("stop", "Stop", null, refusal("stop")) : status !== "done" && button("resume", "Resume", null, refusal("resume")),
      model && viewer(null, "3D view"),
      link(result.model, "point_cloud.ply", "Download PLY"),
      link(result.report, "report.html", "Report"),
    ].filter(Boolean));
    const why = status === "done" || given.allowed ? given.failed ?? "" : `Actions are disabled: ${given.why}`;
    setText(byId("why"), why);
    byId("why").hidden = !why;
  }

  return {
    viewer,
    key: () => JSON.stringify(given),
    ofBlock(row) {
      const pause = row.status === "paused" || row.status === "pausing" ? "unpause" : "pause";
      return [
        button(pause, pause === "pause" ? "Pause" : "Go on", row.block, refusal(pause, row)),
        button("retry", "Retry", row.block, refusal("retry", row)),
      ];
    },
    /** A line for those who cannot hover, where nothing can be done. */
    whyNot(row) {
      const whys = new Set(["pause", "unpause", "retry"].map((action) => refusal(action, row)));
      return whys.has("") ? null : el("p", { class: "muted small" }, `Nothing to do here: ${whys.values().next().value}.`);
    },
    update(run) {
      given = run.actions;
      const key = JSON.stringify([given, run.result, run.summary.status, run.summary.tasks.some((task) => task.checkpoint || task.status === "done")]);
      if (key === drawn) return;
      drawn = key;
      const focused = byId("actions").contains(document.activeElement) ? document.activeElement.textContent : null;
      show(run);
      if (focused) [...byId("actions").children].find((node) => node.textContent === focused)?.focus();
    },
  };
}
