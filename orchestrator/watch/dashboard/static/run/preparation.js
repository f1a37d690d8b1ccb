// How a run makes its scene of panoramas or of a video: its steps, what the reconstruction has kept, and pictures.

/** @import { PictureView, PreparationView, RunPage, StepView } from "../shared/messages.js" */
import { snapshot, urlOf } from "panolog/shared/api.js";
import {
  bar,
  byId,
  childrenOf,
  el,
  reconcile,
  replaceIfChanged,
  setBar,
  setMessage,
  setText,
} from "panolog/shared/dom.js";
import { count, duration } from "panolog/shared/format.js";

/** What is known of the panoramas. @param {PreparationView} view @returns {[string, string][]} */
function numbers({ others, video, frames, panoramas, registered, points, weak_links, contradictions }) {
  /** @type {[string, number | null][]} */
  const all = [
    [others.length && video ? "Panoramas and frames" : video ? "Frames in the video" : "Panoramas", frames],
    [others.length ? "Chosen" : "Frames chosen", video ? panoramas : null],
    ["With a pose", registered],
    ["Without a pose", panoramas === null || registered === null ? null : panoramas - registered],
    ["Points", points],
    ["Weak links", weak_links],
    ["Contradictions", contradictions],
  ];
  return all.flatMap(([label, value]) => (value === null ? [] : [[label, count(value)]]));
}

function makeStep() {
  const head = el("p", { class: "step-head" }, el("b"), el("span", { class: "step-note" }));
  return el("li", { class: "step" }, head, bar(0, ""), el("ul", { class: "step-lines" }));
}

/** @param {HTMLElement} node @param {StepView} step @param {boolean} live */
function fillStep(node, step, live) {
  const [head, progress, lines] = childrenOf(node);
  const [name, note] = childrenOf(head);
  const running = step.status === "running";
  node.dataset.status = live || !running ? step.status : "waiting";
  setText(name, step.label);
  const tally = step.total ? `${step.what} ${count(step.done)} of ${count(step.total)}` : step.what;
  const state = live || !running ? step.status : "last state: running";
  setText(note, [state, tally, step.seconds === null ? "" : duration(step.seconds)].filter(Boolean).join(" · "));
  setBar(progress, step.status === "done" ? 1 : step.total ? step.done / step.total : 0, `progress of ${step.label}`);
  replaceIfChanged(lines, step.lines, () => step.lines.map((line) => el("li", {}, line)));
}

/** @param {string} path of the run below /api @param {PictureView} picture */
function figure(path, { name, label, version }) {
  const url = urlOf(`${path}/preparation/${name}?${version}`);
  const image = el("img", { src: url, alt: label, loading: "lazy" });
  return el(
    "figure",
    {},
    snapshot ? image : el("a", { href: url, target: "_blank" }, image),
    el("figcaption", {}, label),
  );
}

/** @param {string} path of the run below /api */
export function preparation(path) {
  const card = byId("preparation");
  const details = byId("preparation-details", HTMLDetailsElement);
  /** Whether the scene was being made at the last message. @type {boolean | null} */
  let making = null;

  return {
    /** @param {RunPage} run @param {boolean} connected */
    update({ preparation: view, summary }, connected) {
      card.hidden = byId("to-preparation").hidden = !view;
      if (!view) return;
      const now = summary.stage === "prepare";
      if (now !== making) details.open = now; // later the rest of the page matters more
      making = now;
      setMessage(byId("preparation-source"), `of ${[view.source, ...view.others].join(", ")}`);
      reconcile(
        byId("steps"),
        view.steps,
        (step) => step.name,
        makeStep,
        (node, step) => fillStep(node, step, connected),
      );
      reconcile(
        byId("kept"),
        numbers(view),
        ([label]) => label,
        () => el("div", {}, el("dt"), el("dd")),
        (node, pair) => {
          childrenOf(node).forEach((child, i) => setText(child, pair[i]));
        },
      );
      replaceIfChanged(byId("prepared-pictures"), view.pictures, () =>
        view.pictures.map((picture) => figure(path, picture)),
      );
    },
  };
}
