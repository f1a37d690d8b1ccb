// The facts about a run: the head of the page with its stages, the machines, and the settings.

/** @import { NodeView, RunPage, SettingView, StageView } from "../shared/messages.js" */
import { bar, byId, childrenOf, el, first, reconcile, replaceIfChanged, setBar, setMessage, setPill, setText } from "../shared/dom.js";
import { ago, bytes, decibel, duration, fixed, percent, short, taskLabel } from "../shared/format.js";

const REFRESH = 5000; // milliseconds between two updates of times without a message
const MOST = 12; // tasks listed for one machine

/** @param {RunPage} run @returns {[string, string][]} */
function facts({ summary, progress, eta, latest }) {
  const { model, tasks } = summary;
  const coarse = tasks.find((task) => task.name === "coarse");
  const blocks = tasks.filter((task) => task.name.startsWith("block/")).reduce((sum, task) => sum + (task.gaussians ?? 0), 0);
  const live = summary.status === "running";
  return [
    ["Progress", percent(progress)],
    [live ? "ETA" : "Last sign", live ? duration(eta ?? summary.eta) : ago(latest)],
    ["Elapsed", duration(summary.seconds)],
    ["PSNR, held out", decibel(summary.metrics?.psnr)],
    ["Gaussians", short(model?.gaussians ?? (blocks || coarse?.gaussians))],
    ["Size", bytes(model?.bytes)],
  ];
}

function makeStage() {
  return el("li", { class: "stage" }, el("span", { class: "stage-name" }), el("span", { class: "stage-note" }), bar(0, "progress of the stage"));
}

/** @param {HTMLElement} node @param {StageView} stage */
function fillStage(node, stage) {
  node.dataset.status = stage.status;
  const [name, note, progress] = childrenOf(node);
  setText(name, stage.label);
  const end = stage.ended ?? Date.now() / 1000;
  const time = stage.began && (stage.ended || stage.status === "running") ? duration(end - stage.began) : "";
  const tally = stage.tasks > 1 && stage.status !== "done" ? `${stage.done} of ${stage.tasks}` : "";
  setText(note, [stage.status, tally, time].filter(Boolean).join(" · "));
  setBar(progress, stage.status === "done" ? 1 : stage.progress, `progress of ${stage.label}`);
}

export function overview() {
  /** @type {RunPage | null} */
  let last = null;
  /** @param {RunPage} run */
  const update = (run) => {
    last = run;
    const { summary } = run;
    const name = run.name === "." ? run.path.split("/").filter(Boolean).pop() ?? "" : run.name;
    document.title = `${summary.status === "running" ? `${percent(run.progress)} ` : ""}${name} · PanoLOG`;
    setText(byId("name"), name);
    setText(byId("scene"), run.info.scene?.path ?? "");
    setPill(byId("status"), summary.status);
    setMessage(byId("reason"), summary.reason ?? "");
    reconcile(byId("facts"), facts(run), ([label]) => label, () => el("div", {}, el("dt"), el("dd")), (node, fact) => {
      childrenOf(node).forEach((child, i) => setText(child, fact[i]));
    });
    reconcile(byId("stages"), run.stages, (stage) => stage.name, makeStage, fillStage);
  };
  setInterval(() => last && update(last), REFRESH);
  return { update };
}

/** @param {HTMLElement} node @param {NodeView} host */
function fillMachine(node, host) {
  const [title, device, work, numbers] = childrenOf(node);
  const rest = host.tasks.length - MOST;
  setText(title, host.node);
  setText(device, host.gpus.join(", ") || host.device);
  setText(work, host.tasks.length ? host.tasks.slice(0, MOST).map(taskLabel).join(", ") + (rest > 0 ? ` and ${rest} more` : "") : "idle");
  setText(numbers, host.tasks.length ? `${bytes(host.memory)} in use · ${fixed(host.rate, 1)} it/s` : "");
}

export function machines() {
  return {
    /** @param {RunPage} run */
    update({ nodes }) {
      const make = () => el("li", {}, el("h3"), el("span", { class: "muted small" }), el("p"), el("p", { class: "muted small" }));
      reconcile(byId("nodes"), nodes, (host) => host.node, make, fillMachine);
      if (!nodes.length) byId("nodes").replaceChildren(el("li", { class: "empty", "data-key": "" }, "No machine has started to work yet."));
    },
  };
}

/** @param {any} value */
const valueText = (value) => (value === null || value === undefined ? "none" : typeof value === "string" ? value : JSON.stringify(value));

/** @param {SettingView} setting */
function settingRow(setting) {
  const name = el("td", {}, el("code", {}, setting.key), el("span", { class: "doc" }, setting.unit_or_doc));
  const value = el("td", {}, valueText(setting.value), setting.changed && el("span", { class: "changed" }, "changed"));
  return el("tr", { class: setting.changed ? "differs" : null }, name, value, el("td", { class: "muted" }, valueText(setting.default)));
}

export function settings() {
  const [changed, search] = [byId("changed", HTMLInputElement), byId("setting-search", HTMLInputElement)];
  /** @type {SettingView[]} */
  let config = [];
  const show = () => {
    const word = search.value.toLowerCase();
    const found = config.filter((setting) => (!changed.checked || setting.changed) && `${setting.key} ${setting.unit_or_doc}`.toLowerCase().includes(word));
    replaceIfChanged(first("#setting-table tbody"), found, () => found.map(settingRow));
  };
  changed.addEventListener("change", show);
  search.addEventListener("input", show);
  return {
    /** @param {RunPage} run */
    update(run) {
      config = run.config;
      const versions = Object.entries(run.info.versions ?? {}).map(([name, version]) => `${name} ${version}`);
      setText(byId("versions"), [`created ${run.info.created ?? "?"}`, ...versions].join(" · "));
      show();
    },
  };
}
