// Renders next to the photographs: a panorama of each task over the iterations, and the held-out ones at the end.

/** @import { HeldOutView, HeldOutViews, PreviewList, RunEvent, RunPage } from "../shared/messages.js" */
import { get, snapshot, urlOf } from "panolog/shared/api.js";
import { comparison, projections } from "panolog/shared/compare.js";
import { byId, el, replaceIfChanged, setText } from "panolog/shared/dom.js";
import { decibel, fixed, moment, taskLabel } from "panolog/shared/format.js";

/** @param {HeldOutView} view */
const heldOutText = ({ name, metrics }) =>
  `${name}, held out: PSNR ${decibel(metrics?.psnr)}, SSIM ${fixed(metrics?.ssim, 4)}, WS-PSNR ${decibel(metrics?.ws_psnr)}`;

const HATCHED = ["block/", "round/", "repair/"]; // stages whose tasks train a part of the place
const STAGES = ["district", "coarse", "block", "round", "repair"];

/** Stage I first. @param {string} a @param {string} b */
const byStage = (a, b) => STAGES.indexOf(a.split("/")[0]) - STAGES.indexOf(b.split("/")[0]) || a.localeCompare(b);

/** @param {string} path of the run below /api */
export function views(path) {
  const source = byId("view-source", HTMLSelectElement);
  /**
   * `at` is the index of the frame shown; with `latest` it follows new frames; `chosen` is what the user selected.
   * @type {{tasks: string[], heldOut: HeldOutView[], frames: {url: string, text: string}[], at: number, latest: boolean, chosen: string | null, done?: boolean}}
   */
  const state = { tasks: [], heldOut: [], frames: [], at: 0, latest: true, chosen: null };
  const frame = el("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "Iteration" });
  const caption = el("p", { class: "muted small", "aria-live": "off" });
  const compared = comparison("Picture");
  const label = el("label", {}, "Iteration ", frame);
  const row = el("div", { class: "frames", hidden: true }, label, caption);
  const empty = el("p", { class: "empty" }, "Pictures appear during Stage I.");
  const box = compared.box;
  box.hidden = true;
  byId("stage").append(empty, box, row);
  projections(byId("flat"), byId("around"), compared);

  /** Updates which pictures there are. Failures do not matter: this is called with every new picture. */
  async function refresh() {
    /** @type {[PreviewList, HeldOutViews] | null} */
    const lists = await Promise.all([get(`${path}/previews`), get(`${path}/views`)]).catch(() => null);
    if (!lists) return;
    state.tasks = lists[0].previews.map((preview) => preview.task).sort(byStage);
    state.heldOut = lists[1].views;
    byId("views").hidden = byId("to-views").hidden = Boolean(snapshot) && !state.heldOut.length;
    if (state.done && state.heldOut.length) lead();
    replaceIfChanged(source, [state.tasks, state.heldOut.map((view) => view.name)], options);
    if (source.value) await show(source.value);
  }

  /** A finished run begins with its best held-out panorama. */
  function lead() {
    if (byId("lead").classList.contains("pictured")) return;
    byId("lead").classList.add("pictured");
    byId("lead").prepend(byId("views"));
    const best = state.heldOut.reduce((a, b) => ((b.metrics?.psnr ?? 0) > (a.metrics?.psnr ?? 0) ? b : a));
    state.chosen ??= `view/${best.number}`;
  }

  /** Fills the list of pictures, and keeps what was selected. */
  function options() {
    const trained = state.tasks.map((task) =>
      el("option", { value: task, selected: task === (state.chosen ?? state.tasks.at(-1)) }, taskLabel(task)),
    );
    const held = state.heldOut.map(({ number, name }) =>
      el("option", { value: `view/${number}`, selected: `view/${number}` === state.chosen }, name),
    );
    return [
      trained.length ? el("optgroup", { label: "In training" }, trained) : null,
      held.length ? el("optgroup", { label: "Held-out views" }, held) : null,
    ];
  }

  /** Shows the pictures of an option. @param {string} value */
  async function show(value) {
    source.value = value;
    const view = state.heldOut.find(({ number }) => `view/${number}` === value);
    if (view) {
      state.frames = [{ url: urlOf(`${path}/views/${view.number}`) ?? "", text: heldOutText(view) }];
    } else {
      const part = HATCHED.some((stage) => value.startsWith(stage));
      const hatched = part ? " · what is hatched is not trained by this block" : "";
      /** @type {PreviewList} */
      const { previews } = await get(`${path}/previews?task=${encodeURIComponent(value)}`).catch(() => ({
        previews: [],
      }));
      state.frames = previews
        .sort((a, b) => a.event - b.event)
        .map((preview) => ({
          url: urlOf(`${path}/previews/${preview.event}`) ?? "",
          text: `${preview.view}${preview.held_out ? ", held out" : ""}, ${moment(preview.iteration)}${hatched}`,
        }));
    }
    const last = state.frames.length - 1;
    frame.max = String(Math.max(last, 0));
    label.hidden = last < 1;
    showFrame(state.latest ? last : Math.min(state.at, last));
  }

  /** @param {number} index */
  function showFrame(index) {
    const one = state.frames[index];
    box.hidden = row.hidden = !one;
    empty.hidden = Boolean(one);
    if (!one) return;
    state.at = index;
    frame.value = String(index);
    frame.setAttribute("aria-valuetext", one.text);
    setText(caption, one.text);
    compared.show(one.url);
  }

  /** @param {string} value */
  function choose(value) {
    state.chosen = value;
    state.latest = true;
    show(value);
  }

  frame.addEventListener("input", () => {
    state.latest = frame.value === frame.max; // at the end it follows new frames
    showFrame(Number(frame.value));
  });
  source.addEventListener("change", () => choose(source.value));

  return {
    refresh,
    /** @param {string} task */
    choose(task) {
      if (state.tasks.includes(task)) choose(task);
    },
    /** @param {string} name of a held-out panorama */
    chooseView(name) {
      const view = state.heldOut.find((one) => one.name === name);
      if (view) choose(`view/${view.number}`);
    },
    /** @param {RunEvent[]} events */
    add(events) {
      if (events.some((event) => event.type === "PreviewSaved" || event.type === "ViewEvaluated")) refresh();
    },
    /** @param {RunPage} run */
    update(run) {
      const done = run.summary.status === "done";
      if (done && !state.done) setTimeout(refresh); // the held-out views are complete
      state.done = done;
    },
  };
}
