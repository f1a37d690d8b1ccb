// The head of a run: state, the few numbers that matter, and the stages in time.

import { bar, byId, el, reconcile, setPill, setText } from "./dom.js";
import { ago, bytes, decibel, duration, percent, short } from "./format.js";

function facts(run) {
  const { summary } = run;
  const model = summary.model;
  const coarse = summary.tasks.find((task) => task.name === "coarse");
  const blocks = summary.tasks.filter((task) => task.name.startsWith("block/") && task.gaussians);
  const now = blocks.reduce((sum, task) => sum + task.gaussians, 0) || coarse?.gaussians;
  const live = summary.status === "running";
  const psnr = summary.metrics?.psnr;
  return [
    ["Progress", percent(run.progress)],
    [live ? "ETA" : "Last sign", live ? duration(run.eta ?? summary.eta) : ago(run.latest)],
    ["Elapsed", duration(summary.seconds)],
    ["PSNR, held out", decibel(psnr)],
    ["Gaussians", short(model?.gaussians ?? now)],
    ["Size", bytes(model?.bytes)],
  ];
}

function makeStage() {
  return el("li", { class: "stage" }, el("span", { class: "stage-name" }), el("span", { class: "stage-note" }), bar(0, "progress of the stage"));
}

function fillStage(node, stage) {
  node.dataset.status = stage.status;
  const [name, note, progress] = node.children;
  setText(name, stage.label);
  const end = stage.ended ?? Date.now() / 1000;
  const time = stage.began && (stage.ended || stage.status === "running") ? duration(end - stage.began) : "";
  const tally = stage.tasks > 1 && stage.status !== "done" ? `${stage.done} of ${stage.tasks}` : "";
  setText(note, [stage.status, tally, time].filter(Boolean).join(" · "));
  progress.value = stage.status === "done" ? 1 : stage.progress ?? 0;
  progress.setAttribute("aria-label", `progress of ${stage.label}`);
}

export function overview() {
  let last = null;
  const update = (run) => {
    last = run;
    const name = run.name === "." ? run.path.split("/").filter(Boolean).pop() : run.name;
    const { summary } = run;
    document.title = `${summary.status === "running" ? `${percent(run.progress)} ` : ""}${name} · PanoLOG`;
    setText(byId("name"), name);
    setText(byId("scene"), run.info?.scene?.path ?? "");
    setPill(byId("status"), summary.status);
    setText(byId("reason"), summary.reason ?? "");
    byId("reason").hidden = !summary.reason;
    reconcile(byId("facts"), facts(run), ([label]) => label, () => el("div", {}, el("dt"), el("dd")), (node, [label, value]) => {
      setText(node.children[0], label);
      setText(node.children[1], value);
    });
    reconcile(byId("stages"), run.stages, (stage) => stage.name, makeStage, fillStage);
  };
  setInterval(() => last && update(last), 5000); // times go on although nothing happens
  return { update };
}
