// The tables of a comparison: what the runs are, their metrics, and the settings that differ.

/** @import { ComparedRun, Comparison, DifferentSetting, MetricView, Trained } from "../shared/messages.js" */
import { bar, byId, el, pill, replaceIfChanged, setPill, toneOf } from "panolog/shared/dom.js";
import { bytes, count, duration, fixed, METRICS, percent } from "panolog/shared/format.js";

const MISSING = "–";

/** The colour of a run's curves, as a mark. @param {ComparedRun} run */
export function runMark(run) {
  const mark = el("span", { class: "chip", "aria-hidden": "true" });
  mark.style.background = run.color;
  return mark;
}

/** @param {ComparedRun} run @returns {HTMLElement} */
const runHeading = (run) => el("th", { scope: "col" }, runMark(run), run.name);

/** A value with its difference to another, better or worse. @param {number} difference @param {number} digits @param {boolean} lower whether less is better */
export function differenceMark(difference, digits, lower) {
  const text = fixed(Math.abs(difference), digits);
  const none = Number(text) === 0;
  const good = lower ? difference < 0 : difference > 0;
  return el(
    "span",
    { class: `difference ${none ? "" : good ? "good" : "bad"}` },
    `${difference < 0 ? "−" : "+"}${text}`,
  );
}

/** @param {Trained | null} trained */
function iterationsText(trained) {
  if (!trained) return MISSING;
  return trained.iteration >= trained.iterations
    ? count(trained.iterations)
    : `${count(trained.iteration)} of ${count(trained.iterations)}`;
}

/** @param {ComparedRun} run @param {boolean} lost whether there is no connection */
function stateCell(run, lost) {
  const unsure = lost && run.status === "running";
  const mark = pill(run.status);
  setPill(mark, unsure ? "unknown" : toneOf(run), unsure ? "last state: running" : run.label);
  const where = run.status === "done" ? "" : [run.stage, percent(run.progress)].filter(Boolean).join(", ");
  return [
    mark,
    run.error
      ? el("span", { class: "error small below" }, run.error)
      : where && el("span", { class: "muted small below" }, where),
  ];
}

/** What is known of a run, by row. @type {[string, (run: ComparedRun) => string][]} */
const FACTS = [
  ["Recipe", (run) => run.recipe ?? MISSING],
  ["Scene", (run) => run.scene ?? MISSING],
  ["PanoLOG", (run) => run.version ?? MISSING],
  ["Width", (run) => (run.width === null ? MISSING : `${count(run.width)} pixels`)],
  ["Iterations of Stage I", (run) => iterationsText(run.stage_one)],
  [
    "Blocks",
    (run) =>
      run.blocks === null
        ? MISSING
        : run.status === "done"
          ? count(run.blocks)
          : `${count(run.blocks)}, ${count(run.blocks_done)} done`,
  ],
  ["Iterations of Stage II", (run) => iterationsText(run.stage_two)],
  ["Gaussians kept", (run) => count(run.gaussians)],
  ["Size of the PLY", (run) => bytes(run.bytes)],
  ["Peak memory of a task", (run) => bytes(run.memory)],
  ["Peak GPU memory of a task", (run) => bytes(run.gpu_memory)],
  ["Machines", (run) => run.machines.join(", ") || MISSING],
  ["Time", (run) => duration(run.seconds)],
];

/** The stages that a run of the comparison has, in the order of the longest list. @param {ComparedRun[]} runs @returns {[string, string][]} */
function stageRows(runs) {
  /** @type {string[]} */
  const order = [];
  for (const { stages } of runs) {
    stages.forEach(({ name }, i) => {
      if (!order.includes(name)) order.splice(order.indexOf(stages[i - 1]?.name ?? "") + 1, 0, name);
    });
  }
  const labels = new Map(
    runs.flatMap(({ stages }) => stages.map(({ name, label }) => /** @type {[string, string]} */ ([name, label]))),
  );
  return order.map((name) => [name, labels.get(name) ?? name]);
}

/** @param {string} label @param {string[]} cells @param {string} [kind] */
const textRow = (label, cells, kind) =>
  el(
    "tr",
    { class: kind },
    el("th", { scope: "row" }, label),
    cells.map((cell) => el("td", {}, cell)),
  );

/** What the runs are and have come to; rows that no run has are left out. @param {Comparison} comparison @param {boolean} lost */
export function showFacts({ runs }, lost) {
  byId("content").style.setProperty("--runs", String(runs.length));
  replaceIfChanged(byId("facts"), [runs.map((run) => ({ ...run, metrics: null })), lost], () => {
    const rows = FACTS.map(([label, text]) => /** @type {[string, string[]]} */ ([label, runs.map(text)])).filter(
      ([, cells]) => cells.some((cell) => cell !== MISSING),
    );
    const stages = stageRows(runs).map(([name, label]) =>
      textRow(
        label,
        runs.map((run) => duration(run.stages.find((stage) => stage.name === name)?.seconds)),
        "part",
      ),
    );
    return [
      el("caption", { class: "unseen" }, "The runs"),
      el("thead", {}, el("tr", {}, el("td"), runs.map(runHeading))),
      el(
        "tbody",
        {},
        el(
          "tr",
          {},
          el("th", { scope: "row" }, "State"),
          runs.map((run) => el("td", {}, ...stateCell(run, lost))),
        ),
        rows.map(([label, cells]) => textRow(label, cells)),
        stages,
      ),
    ];
  });
}

/** @param {MetricView | undefined} metric @param {typeof METRICS[number]} kind @param {number} most the highest mean @param {ComparedRun} run */
function metricCell(metric, kind, most, run) {
  if (metric?.mean === null || metric === undefined) return el("td", { class: "muted" }, MISSING);
  const share = bar(most > 0 ? metric.mean / most : 0, `${kind.label} of ${run.name}`);
  share.style.setProperty("--tone", run.color);
  const { difference, panoramas, better, worse } = metric;
  return el(
    "td",
    {},
    el("span", { class: "mean" }, fixed(metric.mean, kind.digits)),
    difference !== null && differenceMark(difference, kind.digits, kind.lower),
    share,
    Boolean(panoramas) &&
      el(
        "span",
        { class: "muted small below" },
        better || worse
          ? `better in ${count(better)}, worse in ${count(worse)} of ${count(panoramas)}`
          : `the same in ${count(panoramas)}`,
      ),
  );
}

/** The means over the held-out panoramas, and how they differ from those of the first run. @param {Comparison} comparison */
export function showMetrics({ runs, first }) {
  const known = METRICS.filter(({ key }) => runs.some((run) => (run.metrics[key]?.mean ?? null) !== null));
  byId("metrics-empty").hidden = known.length > 0;
  byId("metrics-scroll").hidden = known.length === 0;
  byId("metrics-note").textContent = known.length
    ? `Means over the held-out panoramas, compared with ${runs[first].name}.`
    : "";
  replaceIfChanged(
    byId("metrics"),
    runs.map(({ name, color, metrics }) => [name, color, metrics]),
    () => [
      el("caption", { class: "unseen" }, "Metrics"),
      el("thead", {}, el("tr", {}, el("td"), runs.map(runHeading))),
      el(
        "tbody",
        {},
        known.map((kind) => {
          const most = Math.max(...runs.map((run) => run.metrics[kind.key]?.mean ?? 0));
          return el(
            "tr",
            {},
            el("th", { scope: "row" }, kind.label, kind.unit && el("span", { class: "unit" }, kind.unit)),
            runs.map((run) => metricCell(run.metrics[kind.key], kind, most, run)),
          );
        }),
      ),
    ],
  );
}

/** @param {any} value */
const settingText = (value) =>
  value === null || value === undefined ? "none" : typeof value === "string" ? value : JSON.stringify(value);

/** A name that may be broken after its dots and underscores. @param {string} name */
const breakable = (name) => name.split(/(?<=[._])/).flatMap((part) => [part, el("wbr")]);

/** @param {DifferentSetting} setting */
const settingRow = ({ key, values, known, doc }) =>
  el(
    "tr",
    {},
    el("th", { scope: "row" }, el("code", {}, breakable(key)), el("span", { class: "doc" }, doc)),
    values.map((value, i) => el("td", {}, known[i] ? settingText(value) : MISSING)),
  );

/** @param {Comparison} comparison */
export function showSettings({ runs, settings, more_settings: more }) {
  byId("settings-empty").hidden = settings.length > 0;
  byId("settings-scroll").hidden = settings.length === 0;
  byId("settings-more").hidden = more === 0;
  byId("settings-more").textContent = `and ${count(more)} more`;
  replaceIfChanged(byId("settings"), [runs.map(({ name }) => name), settings], () => [
    el("caption", { class: "unseen" }, "Settings that differ"),
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Setting"), runs.map(runHeading))),
    el("tbody", {}, settings.map(settingRow)),
  ]);
}

/** Why the comparison is not fair. @param {Comparison} comparison */
export function showWarnings({ warnings }) {
  byId("warnings").hidden = warnings.length === 0;
  replaceIfChanged(byId("warning-list"), warnings, () => warnings.map((line) => el("li", {}, line)));
}
