// The curves of all runs of a comparison on one axis.

import { runMark } from "panolog/compare/tables.js";
/** @import { ComparedRun, CurvesOfRuns, StageCurves } from "../shared/messages.js" */
import { CHARTS, chartLayout, chartTitle } from "panolog/shared/charts.js";
import { byId, el, replaceIfChanged, setMessage } from "panolog/shared/dom.js";
import { draw, themed } from "panolog/shared/plot.js";

const COMPARED = CHARTS.filter(({ key }) => ["loss", "psnr", "gaussians"].includes(key));
/** The title of each axis. @type {{iterations: string, minutes: string}} */
const AXES = { iterations: "iteration, one stage after the other", minutes: "minutes" };

/** The points of a run on an axis: its stages with a gap between them. @param {StageCurves[]} stages @param {string} name @param {keyof typeof AXES} axis */
function stagePoints(stages, name, axis) {
  /** @type {{x: (number | null)[], y: (number | null)[]}} */
  const points = { x: [], y: [] };
  for (const { curves } of stages) {
    const line = curves[name]?.[axis];
    if (!line) continue;
    points.x.push(...line.x, null);
    points.y.push(...line.y, null);
  }
  return points;
}

/** What a reader must know of curves that are not of all tasks. @param {ComparedRun[]} runs @param {CurvesOfRuns} sent */
function curveNotes(runs, sent) {
  return sent.runs
    .flatMap(({ stages, error }, i) => [
      ...(error && !runs[i]?.error ? [`${runs[i]?.name}: no curves: ${error}`] : []),
      ...stages
        .filter(({ tasks, read }) => read < tasks)
        .map(({ label, tasks, read }) => `${runs[i]?.name}: ${label} as ${read} of its ${tasks} tasks have it`),
    ])
    .join("; ");
}

export function comparedCurves() {
  /** @type {{runs: ComparedRun[], sent: CurvesOfRuns, hidden: Set<string>, axis: keyof typeof AXES}} */
  const state = { runs: [], sent: { runs: [] }, hidden: new Set(), axis: "iterations" };
  const charts = COMPARED.map((kind) => ({
    kind,
    node: el("div", { class: "plot chart", role: "img", "aria-label": chartTitle(kind) }),
  }));
  byId("charts").append(
    ...charts.map(({ kind, node }) => el("figure", {}, el("figcaption", {}, chartTitle(kind)), node)),
  );

  async function render() {
    const shown = state.runs
      .map((run, i) => ({ run, stages: state.sent.runs[i]?.stages ?? [] }))
      .filter(({ run }) => !state.hidden.has(run.id));
    const none = state.sent.runs.every(({ stages }) => stages.length === 0);
    byId("charts").hidden = none;
    byId("curves-empty").hidden = !none;
    setMessage(byId("curves-note"), curveNotes(state.runs, state.sent));
    if (none) return;
    await Promise.all(
      charts.map(({ kind, node }) => {
        const layout = chartLayout(kind);
        layout.xaxis.title.text = AXES[state.axis];
        layout.uirevision = state.axis;
        const traces = shown.map(({ run, stages }) => ({
          type: "scatter",
          mode: "lines",
          ...stagePoints(stages, kind.key, state.axis),
          name: run.name.slice(0, 40),
          line: { color: run.color, width: 1.7 },
          connectgaps: false,
          showlegend: false,
          hovertemplate: "%{y:.4~g}",
        }));
        return draw(node, traces, themed(layout));
      }),
    );
  }

  function chips() {
    replaceIfChanged(
      byId("shown"),
      state.runs.map(({ id, name, color }) => [id, name, color, state.hidden.has(id)]),
      () =>
        state.runs.map((run) => {
          const on = !state.hidden.has(run.id);
          const toggle = () => {
            if (!state.hidden.delete(run.id)) state.hidden.add(run.id);
            chips();
            render();
          };
          return el(
            "button",
            { type: "button", class: "chip-button", "aria-pressed": String(on), on: { click: toggle } },
            runMark(run),
            run.name,
          );
        }),
    );
  }

  const buttons = { iterations: byId("by-iterations"), minutes: byId("by-minutes") };
  for (const axis of /** @type {const} */ (["iterations", "minutes"])) {
    buttons[axis].addEventListener("click", () => {
      state.axis = axis;
      for (const [name, button] of Object.entries(buttons)) button.setAttribute("aria-pressed", String(name === axis));
      render();
    });
  }

  return {
    render,
    /** @param {ComparedRun[]} runs */
    update(runs) {
      const begun = state.runs.length > 0;
      state.runs = runs;
      chips();
      if (!begun) render(); // the curves may have arrived first
    },
    /** @param {CurvesOfRuns} sent */
    add(sent) {
      state.sent = sent;
      return render();
    },
  };
}
