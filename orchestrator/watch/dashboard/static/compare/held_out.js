// The held-out panoramas of a comparison: a slider between any two of the runs and the ground truth, and the metrics of
// each panorama.

import { differenceMark, runMark } from "panolog/compare/tables.js";
/** @import { ComparedView, Comparison } from "../shared/messages.js" */
/** @import { Side } from "../shared/compare.js" */
import { comparison, projections } from "panolog/shared/compare.js";
import { byId, el, replaceIfChanged, setText } from "panolog/shared/dom.js";
import { count, fixed, METRICS } from "panolog/shared/format.js";

const TRUTH = "truth";

export function heldOut() {
  const [panorama, left, right, metric] = ["panorama", "left", "right", "metric"].map((id) =>
    byId(id, HTMLSelectElement),
  );
  const compared = comparison("Panorama");
  byId("stage").append(compared.box);
  projections(byId("flat", HTMLButtonElement), byId("around", HTMLButtonElement), compared);
  metric.append(...METRICS.map(({ key, label }) => el("option", { value: key }, label)));
  /** @type {Comparison | null} */
  let known = null;
  /** What the user has chosen; until then the first panorama and the first two runs with a picture. @type {Record<string, string>} */
  const chosen = {};

  /** The picture of a side: of a run by its index, or the ground truth. @param {ComparedView} view @param {string} side @returns {Side | null} */
  function sideOf(view, side) {
    const url = side === TRUTH ? view.truth : view.pictures[Number(side)];
    return url
      ? { url, truth: side === TRUTH, label: side === TRUTH ? "ground truth" : (known?.runs[Number(side)].name ?? "") }
      : null;
  }

  /** @param {string[]} sides that have a picture @param {string | undefined} wanted @param {number} otherwise index of the side by default */
  const sideFor = (sides, wanted, otherwise) =>
    wanted !== undefined && sides.includes(wanted) ? wanted : (sides[otherwise] ?? "");

  function showPicture() {
    if (!known) return;
    const views = known.views.filter(({ pictures }) => pictures.some(Boolean));
    const view = views.find(({ name }) => name === chosen.panorama) ?? views[0];
    byId("pictures").hidden = !view;
    byId("pictures-empty").hidden = Boolean(view);
    if (!view) return;
    const runs = known.runs;
    const sides = [...runs.keys()]
      .map(String)
      .concat(TRUTH)
      .filter((side) => sideOf(view, side));
    const pair = [sideFor(sides, chosen.left, 0), sideFor(sides, chosen.right, 1)];
    replaceIfChanged(
      panorama,
      views.map(({ name }) => name),
      () => views.map(({ name }) => el("option", { value: name }, name)),
    );
    [left, right].forEach((select, i) => {
      replaceIfChanged(select, [sides, runs.map(({ name }) => name)], () =>
        sides.map((side) => el("option", { value: side }, side === TRUTH ? "ground truth" : runs[Number(side)].name)),
      );
      select.value = pair[i];
    });
    panorama.value = view.name;
    const [one, other] = pair.map((side) => sideOf(view, side));
    if (one && other) compared.pair(one, other);
    setText(byId("picture-caption"), captionOf(view, pair));
  }

  /** @param {ComparedView} view @param {string[]} pair */
  function captionOf(view, pair) {
    const texts = pair
      .filter((side) => side !== TRUTH)
      .map((side) => {
        const metrics = view.metrics[Number(side)];
        const values = METRICS.filter(({ key }) => (metrics?.[key] ?? null) !== null).map(
          ({ key, label, digits }) => `${label} ${fixed(metrics?.[key], digits)}`,
        );
        return `${known?.runs[Number(side)].name}: ${values.join(", ") || "not measured"}`;
      });
    return [view.name, ...texts].join(" · ");
  }

  function showTable() {
    if (!known) return;
    const { runs, views, first, more_views: more } = known;
    const kind = METRICS.find(({ key }) => key === metric.value) ?? METRICS[0];
    byId("views-table").hidden = views.length === 0;
    byId("views-more").hidden = more === 0;
    setText(byId("views-more"), `and ${count(more)} more`);
    const key = [
      kind.key,
      runs.map(({ name, color }) => [name, color]),
      views.map(({ name, metrics, pictures }) => [
        name,
        metrics.map((values) => values?.[kind.key]),
        pictures.some(Boolean),
      ]),
    ];
    replaceIfChanged(byId("views"), key, () => [
      el("caption", { class: "unseen" }, "The held-out panoramas"),
      el(
        "thead",
        {},
        el(
          "tr",
          {},
          el("th", { scope: "col" }, "Panorama"),
          runs.map((run) => el("th", { scope: "col" }, runMark(run), run.name)),
        ),
      ),
      el(
        "tbody",
        {},
        views.map((view) =>
          el(
            "tr",
            {},
            el("th", { scope: "row" }, nameOf(view)),
            view.metrics.map((values, i) =>
              cell(values?.[kind.key] ?? null, i === first ? null : (view.metrics[first]?.[kind.key] ?? null), kind),
            ),
          ),
        ),
      ),
    ]);
  }

  /** @param {ComparedView} view */
  function nameOf(view) {
    if (!view.pictures.some(Boolean)) return view.name;
    const choose = () => {
      chosen.panorama = view.name;
      showPicture();
      byId("held-out").scrollIntoView();
    };
    return el("button", { type: "button", class: "row-name", on: { click: choose } }, view.name);
  }

  /** @param {number | null} value @param {number | null} other of the first run @param {typeof METRICS[number]} kind */
  const cell = (value, other, kind) =>
    el(
      "td",
      {},
      el("span", { class: "mean" }, fixed(value, kind.digits)),
      value !== null && other !== null && differenceMark(value - other, kind.digits, kind.lower),
    );

  for (const select of [panorama, left, right]) {
    select.addEventListener("change", () => {
      chosen[select.id] = select.value;
      showPicture();
    });
  }
  metric.addEventListener("change", showTable);

  return {
    /** @param {Comparison} sent */
    update(sent) {
      const begun = known !== null && known.views.length > 0;
      known = sent;
      if (!begun)
        metric.value =
          METRICS.find(({ key }) =>
            sent.views.some(({ metrics }) => metrics.some((values) => (values?.[key] ?? null) !== null)),
          )?.key ?? METRICS[0].key;
      showPicture();
      showTable();
    },
  };
}
