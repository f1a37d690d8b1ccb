// Renders beside the truth: training views of each task over the iterations, and the held-out views at the end.

import { get } from "./api.js";
import { byId, el, setText } from "./dom.js";
import { count, decibel, fixed, taskLabel } from "./format.js";
import { panorama } from "./panorama.js";

export function views(path) {
  const source = byId("view-source");
  const state = { tasks: [], heldOut: [], frames: [], at: 0, latest: true, chosen: null };
  const frame = el("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "Iteration" });
  const split = el("input", { type: "range", min: 0, max: 100, value: 50, class: "split", "aria-label": "How much of the render is shown; the truth is beside it" });
  const caption = el("p", { class: "muted small", "aria-live": "off" });
  const box = el("div", { class: "compare" });
  const render = el("div", { class: "half render" }, el("img", { alt: "render" }));
  const truth = el("div", { class: "half truth" }, el("img", { alt: "the photograph" }));
  const around = panorama(split);
  const tags = [el("span", { class: "tag left", "aria-hidden": "true" }, "render"), el("span", { class: "tag right", "aria-hidden": "true" }, "truth")];
  box.append(truth, render, around.canvas, el("span", { class: "divider", "aria-hidden": "true" }), ...tags, split);
  const row = el("div", { class: "frames" }, el("label", {}, "Iteration ", frame), caption);
  const empty = el("p", { class: "empty" }, "Pictures appear while Stage I trains.");
  byId("stage").append(empty, box, row);
  box.hidden = row.hidden = true;

  const cut = () => {
    box.style.setProperty("--split", `${split.value}%`);
    around.split(split.value / 100);
  };
  split.addEventListener("input", cut);

  /** Which pictures there are. Failures show at the next one: this is asked with every news. */
  async function refresh() {
    const [trained, held] = await Promise.all([get(`${path}/previews`), get(`${path}/views`)]).catch(() => [null, null]);
    if (!trained) return;
    state.tasks = trained.previews.map((preview) => preview.task).sort((a, b) => (a === "coarse" ? -1 : b === "coarse" ? 1 : a.localeCompare(b)));
    state.heldOut = held.views;
    options();
    if (source.value) await choose(source.value);
  }

  function options() {
    const wanted = JSON.stringify([state.tasks, state.heldOut.map((view) => view.name)]);
    if (source.dataset.key === wanted) return;
    source.dataset.key = wanted;
    const trained = state.tasks.map((task) => el("option", { value: task }, taskLabel(task)));
    const held = state.heldOut.map((view) => el("option", { value: `view/${view.number}` }, view.name));
    const groups = [["Training views", trained], ["Held-out views", held]].filter(([, list]) => list.length);
    source.replaceChildren(...groups.map(([label, list]) => el("optgroup", { label }, list)));
    if (state.chosen && [...source.options].some((option) => option.value === state.chosen)) source.value = state.chosen;
    else if (state.tasks.length) source.value = state.tasks.at(-1);
  }

  async function choose(value) {
    source.value = value;
    if (value.startsWith("view/")) {
      const view = state.heldOut.find((one) => `view/${one.number}` === value);
      state.frames = [{ url: `/api/${path}/views/${view.number}`, text: heldOutText(view) }];
    } else {
      const { previews } = await get(`${path}/previews?task=${encodeURIComponent(value)}`).catch(() => ({ previews: [] }));
      state.frames = previews.sort((a, b) => a.event - b.event).map((one) => ({
        url: `/api/${path}/previews/${one.event}`, text: `${one.view}, iteration ${count(one.iteration)}`,
      }));
    }
    frame.max = Math.max(state.frames.length - 1, 0);
    frame.parentElement.hidden = state.frames.length < 2;
    show(state.latest ? state.frames.length - 1 : Math.min(state.at, state.frames.length - 1));
  }

  const heldOutText = ({ name, metrics }) => `${name}, held out: PSNR ${decibel(metrics?.psnr)}, SSIM ${fixed(metrics?.ssim, 4)}, WS-PSNR ${decibel(metrics?.ws_psnr)}`;

  function show(index) {
    const one = state.frames[index];
    box.hidden = row.hidden = !one;
    empty.hidden = Boolean(one);
    if (!one) return;
    state.at = index;
    frame.value = index;
    frame.setAttribute("aria-valuetext", one.text);
    setText(caption, one.text);
    for (const image of box.querySelectorAll("img")) if (image.getAttribute("src") !== one.url) image.src = one.url;
    around.load(render.firstChild);
    cut();
  }

  function project(whole) {
    byId("flat").setAttribute("aria-pressed", String(!whole));
    byId("around").setAttribute("aria-pressed", String(whole));
    box.classList.toggle("around", whole);
    around.show(whole);
    if (whole) around.canvas.focus();
  }

  render.firstChild.addEventListener("load", () => around.load(render.firstChild));
  frame.addEventListener("input", () => {
    state.latest = Number(frame.value) === state.frames.length - 1; // at the end it follows what comes
    show(Number(frame.value));
  });
  source.addEventListener("change", () => {
    state.chosen = source.value;
    state.latest = true;
    choose(source.value);
  });
  byId("flat").addEventListener("click", () => project(false));
  byId("around").addEventListener("click", () => project(true));
  if (!around.possible) Object.assign(byId("around"), { disabled: true, title: "this browser has no WebGL" });

  return {
    refresh,
    choose(task) {
      if (![...source.options].some((option) => option.value === task)) return;
      state.chosen = task;
      state.latest = true;
      choose(task);
    },
    add(events) {
      if (events.some((event) => event.type === "PreviewSaved" || event.type === "ViewEvaluated")) refresh();
    },
    update(run) {
      const done = run.summary.status === "done";
      if (done && state.done === false) refresh(); // the held-out views are complete
      state.done = done;
    },
  };
}
