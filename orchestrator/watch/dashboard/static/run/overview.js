// The facts about a run: the head of the page with its stages, the machines, and the settings.

/** @import { ActionButtons } from "./actions.js" */
/** @import { NodeView, RunPage, SettingView, StageView, SummaryHead, UsageView } from "../shared/messages.js" */
import { snapshot } from "panolog/shared/api.js";
import {
  bar,
  byId,
  childrenOf,
  el,
  first,
  pill,
  reconcile,
  replaceIfChanged,
  setBar,
  setMessage,
  setPill,
  setText,
  table,
} from "panolog/shared/dom.js";
import {
  ago,
  bytes,
  clock,
  count,
  decibel,
  duration,
  fixed,
  percent,
  shellWord,
  short,
  significant,
  taskLabel,
} from "panolog/shared/format.js";

const REFRESH = 5000; // milliseconds between two updates of times without a message
const FULL = 0.9; // share of what a machine has from which on little is left
const MOST = 12; // tasks listed for one machine

/**
 * @param {RunPage} run
 * @param {boolean} live whether it runs, and the page knows that
 * @param {number} since seconds for which it has run since the message
 * @returns {[string, string][]}
 */
function facts({ info, summary, progress, eta, latest, store }, live, since) {
  const { model, seconds } = summary;
  return [
    ["Progress", percent(progress)],
    live ? ["ETA", duration(eta)] : ["Last update", ago(latest)],
    ["Elapsed", duration(seconds === null ? null : seconds + since)],
    ["PSNR, held out", info.config?.holdout === "none" ? "not measured" : decibel(summary.metrics?.psnr)],
    live || !model ? ["Gaussians in training", short(summary.training_gaussians)] : ["Size", bytes(model.bytes)],
    ["Gaussians kept", short(summary.kept_gaussians)],
    ...costs(summary.money),
    .../** @type {[string, string][]} */ (store ? [["Object store", store]] : []), // a sentence: the last, in a row of its own
  ];
}

/** What the run has cost, where prices are known. @param {SummaryHead["money"]} money @returns {[string, string][]} */
function costs(money) {
  if (!money || money.used.cost === null) return [];
  /** @param {number | null} cost */
  const amount = (cost) => `${fixed(cost ?? 0, 2)} ${money.currency}`;
  const limit = money.max_cost === null ? "" : ` of ${fixed(money.max_cost, 2)}`;
  return [
    ["Cost", `${fixed(money.used.cost, 2)}${limit} ${money.currency}`],
    ["Of it idle", amount(money.idle.cost)],
    ["Of it lost", amount(money.lost.cost)],
  ];
}

/** What the machines of each kind have cost. @param {SummaryHead["money"]} money */
function showCost(money) {
  byId("cost").hidden = byId("to-cost").hidden = !money || money.used.cost === null;
  if (!money) return;
  replaceIfChanged(byId("cost-table"), money, () => [
    table(money.kinds, [
      ["Machine", ({ kind }) => kind],
      ["Machines", (kind) => count(kind.count), "number"],
      [`${money.currency} per hour`, ({ price }) => significant(price), "number"],
      ["Hours", ({ used }) => fixed(used.seconds / 3600), "number"],
      ["Cost", ({ used }) => fixed(used.cost), "number"],
      ["Idle", ({ idle }) => fixed(idle.cost), "number"],
      ["Lost", ({ lost }) => fixed(lost.cost), "number"],
    ]),
  ]);
}

/** What to do about a run that ended before it was done. @param {RunPage} run @returns {[string, string] | null} */
function hint({ summary: { status, stage }, progress, eta, latest, path }) {
  if (snapshot && status !== "running") return null;
  const left = eta === null ? "" : `, about ${duration(eta)} left`;
  if (snapshot) return [`The run was still running when this was written: ${percent(progress)} done${left}.`, ""];
  const resume = `panolog resume ${shellWord(path)}`;
  const kept = stage === "prepare" ? "What is done is kept" : "The checkpoints are kept";
  const last = latest ? ` Last update: ${clock(latest)}, ${ago(latest)}.` : "";
  if (status === "stopped") return [`${kept}.${last} To resume the run:`, resume];
  if (status === "limited")
    return [
      "A limit has ended the training early; the model is what there was. To complete the run, also with a higher limit:",
      `${resume} --max-cost none --deadline none`,
    ];
  if (status === "interrupted") return [`The run was stopped. ${kept}. To resume it:`, resume];
  return status === "failed" ? ["To try again from the last checkpoints:", resume] : null;
}

function makeStage() {
  return el(
    "li",
    { class: "stage" },
    el("span", { class: "stage-name" }),
    el("span", { class: "stage-note" }),
    bar(0, "progress of the stage"),
  );
}

/**
 * @param {HTMLElement} node
 * @param {StageView} stage
 * @param {number} since seconds for which it has run since the message
 * @param {boolean} live
 * @param {number | null} first when the run began
 */
function fillStage(node, stage, since, live, first) {
  const running = stage.status === "running";
  node.dataset.status = live || !running ? stage.status : "waiting";
  const [name, note, progress] = childrenOf(node);
  setText(name, stage.label);
  const time = stage.seconds === null ? "" : duration(stage.seconds + (running ? since : 0));
  const tally = stage.tasks > 1 && stage.status !== "done" ? `${stage.done} of ${stage.tasks}` : "";
  const from = stage.began ? `from ${clock(stage.began, first ?? undefined)}` : "";
  setText(
    note,
    [live || !running ? stage.status : "last state: running", tally, time, from].filter(Boolean).join(" · "),
  );
  setBar(progress, stage.status === "done" ? 1 : stage.progress, `progress of ${stage.label}`);
}

export function overview() {
  /** The last message, and when it came. @type {{run: RunPage, came: number} | null} */
  let last = null;
  /** When the connection was lost. @type {number | null} */
  let lost = null;

  function show() {
    if (!last) return;
    const { run, came } = last;
    const { summary } = run;
    const running = summary.status === "running";
    const live = running && lost === null;
    const since = Math.max((lost ?? Date.now() / 1000) - came, 0); // by this machine's clock alone
    const name = run.name === "." ? (run.path.split("/").filter(Boolean).pop() ?? "") : run.name;
    document.title = `${live ? `${percent(run.progress)} ` : ""}${name} · PanoLOG`;
    setText(byId("name"), name);
    setText(
      byId("scene"),
      [run.info.scene?.path, run.began && `began ${clock(run.began)}`].filter(Boolean).join(" · "),
    );
    setPill(
      byId("status"),
      running && !live ? "unknown" : summary.waiting ? "paused" : summary.status,
      running && !live ? "last state: running" : summary.label,
    );
    setMessage(byId("reason"), summary.waiting === summary.label ? "" : summary.waiting || (summary.reason ?? ""));
    const [text, command] = hint(run) ?? ["", ""];
    byId("hint").hidden = !text;
    setText(byId("hint-text"), text);
    setText(byId("hint-command"), command);
    reconcile(
      byId("facts"),
      facts(run, live, running ? since : 0),
      ([label]) => label,
      () => el("div", {}, el("dt"), el("dd")),
      (node, fact) => {
        childrenOf(node).forEach((child, i) => setText(child, fact[i]));
      },
    );
    showCost(summary.money);
    reconcile(
      byId("stages"),
      run.stages,
      (stage) => stage.name,
      makeStage,
      (node, stage) => fillStage(node, stage, running ? since : 0, live, run.began),
    );
  }

  setInterval(show, REFRESH);
  return {
    /** @param {RunPage} run @param {number | null} since when the connection was lost, in seconds since the epoch; null while there is one */
    update(run, since) {
      if (since === null || last === null) last = { run, came: Date.now() / 1000 };
      lost = since;
      show();
    },
  };
}

/** Label, text and share of each thing that a machine has: what is not known is left out. @param {UsageView} usage @returns {[string, string, number][]} */
function meters({ cpu, memory_used, memory_total, disk_used, disk_total, gpus }) {
  /** @type {[string, string, number | null][]} */
  const all = [
    ["CPU", percent(cpu), cpu],
    ["Memory", `${bytes(memory_used)} of ${bytes(memory_total)}`, memory_used / memory_total],
    ...gpus.flatMap(({ utilization, memory_used: used, memory_total: total }, i) => {
      const label = gpus.length > 1 ? `GPU ${i}` : "GPU";
      /** @type {[string, string, number | null][]} */
      const both = [
        [label, percent(utilization), utilization],
        [`${label} memory`, `${bytes(used)} of ${bytes(total)}`, used !== null && total ? used / total : null],
      ];
      return both;
    }),
    ["Disk", `${bytes(disk_used)} of ${bytes(disk_total)}`, disk_used / disk_total],
  ];
  return all.flatMap(([label, text, share]) =>
    share === null || !Number.isFinite(share) ? [] : [[label, text, share]],
  );
}

/** Why a machine gets no tasks, and its release. @param {HTMLElement} node @param {NodeView} host @param {number} now @param {ActionButtons} acts */
function fillQuarantine(node, { quarantine }, now, acts) {
  const mark = pill("failed");
  setPill(mark, "failed", "quarantined");
  node.hidden = !quarantine;
  const left = quarantine && duration(Math.max(quarantine.until - now, 0));
  replaceIfChanged(node, [quarantine, left, acts.key()], () =>
    quarantine
      ? [
          el("p", {}, mark, ` ${left} left, until ${clock(quarantine.until)}`),
          el("p", { class: "small" }, quarantine.reason),
          acts.ofMachine(quarantine),
        ]
      : [],
  );
}

/** That a machine leaves, and when. @param {HTMLElement} node @param {NodeView} host @param {number} now */
function fillLeaving(node, { leaving }, now) {
  const mark = pill("paused");
  setPill(mark, "paused", "leaves");
  node.hidden = !leaving;
  const left = leaving && leaving.until !== null ? `${duration(Math.max(leaving.until - now, 0))} left` : "";
  replaceIfChanged(node, [leaving, left], () =>
    leaving ? [el("p", {}, mark, ` ${left}`), el("p", { class: "small" }, leaving.reason)] : [],
  );
}

/** @param {HTMLElement} node @param {NodeView} host @param {number} now by the server's clock @param {ActionButtons} acts */
function fillMachine(node, host, now, acts) {
  const [title, device, leaving, quarantine, work, numbers, usage, measured] = childrenOf(node);
  fillLeaving(leaving, host, now);
  fillQuarantine(quarantine, host, now, acts);
  const rest = host.tasks.length - MOST;
  setText(title, host.node);
  setText(device, host.gpus.join(", ") || host.device);
  setText(
    work,
    host.tasks.length
      ? host.tasks.slice(0, MOST).map(taskLabel).join(", ") + (rest > 0 ? ` and ${rest} more` : "")
      : host.quarantine || host.leaving
        ? ""
        : "idle",
  );
  setText(
    numbers,
    host.tasks.length ? `${bytes(host.memory)} used by tasks${host.rate ? ` · ${fixed(host.rate, 1)} it/s` : ""}` : "",
  );
  const makeMeter = () => el("li", {}, el("span"), bar(0, ""), el("span", { class: "number" }));
  reconcile(
    usage,
    host.usage ? meters(host.usage) : [],
    ([label]) => label,
    makeMeter,
    (item, [label, text, share]) => {
      const [name, meter, value] = childrenOf(item);
      setText(name, label);
      setBar(meter, share, `${label} of ${host.node}`);
      setText(value, text);
      item.dataset.full = String(share >= FULL);
    },
  );
  setMessage(measured, host.usage ? `measured ${clock(host.usage.time)}` : "");
}

/** @param {ActionButtons} acts */
export function machines(acts) {
  return {
    /** @param {RunPage} run */
    update({ nodes, now }) {
      const make = () =>
        el(
          "li",
          {},
          el("h3"),
          el("span", { class: "muted small" }),
          el("div", { class: "quarantine" }),
          el("div", { class: "quarantine" }),
          el("p"),
          el("p", { class: "muted small" }),
          el("ul", { class: "meters" }),
          el("p", { class: "muted small" }),
        );
      reconcile(
        byId("nodes"),
        nodes,
        (host) => host.node,
        make,
        (node, host) => fillMachine(node, host, now, acts),
      );
      if (!nodes.length)
        byId("nodes").replaceChildren(el("li", { class: "empty", "data-key": "" }, "No machine is in use yet."));
    },
  };
}

/** @param {any} value */
const valueText = (value) =>
  value === null || value === undefined ? "none" : typeof value === "string" ? value : JSON.stringify(value);

/** @param {SettingView} setting */
function settingRow(setting) {
  const name = el("td", {}, el("code", {}, setting.key), el("span", { class: "doc" }, setting.unit_or_doc));
  const value = el("td", {}, valueText(setting.value), setting.changed && el("span", { class: "changed" }, "changed"));
  return el(
    "tr",
    { class: setting.changed ? "differs" : null },
    name,
    value,
    el("td", { class: "muted" }, valueText(setting.default)),
  );
}

export function settings() {
  const [changed, search] = [byId("changed", HTMLInputElement), byId("setting-search", HTMLInputElement)];
  /** @type {SettingView[]} */
  let config = [];
  const show = () => {
    const word = search.value.toLowerCase();
    const found = config.filter(
      (setting) =>
        (!changed.checked || setting.changed) && `${setting.key} ${setting.unit_or_doc}`.toLowerCase().includes(word),
    );
    const none =
      config.length && changed.checked && !word ? "All settings are the defaults." : "No setting has these words.";
    replaceIfChanged(first("#setting-table tbody"), found, () =>
      found.length ? found.map(settingRow) : [el("tr", {}, el("td", { colspan: 3, class: "muted" }, none))],
    );
  };
  changed.addEventListener("change", show);
  search.addEventListener("input", show);
  return {
    /** @param {RunPage} run */
    update(run) {
      config = run.config;
      const versions = Object.entries(run.info.versions ?? {}).map(([name, version]) => `${name} ${version}`);
      const { created, seed, scene } = run.info;
      setText(
        byId("versions"),
        [`created ${created ?? "?"}`, ...versions, `seed ${seed ?? "?"}`, `scene ${scene?.fingerprint ?? "?"}`].join(
          " · ",
        ),
      );
      show();
    },
  };
}
