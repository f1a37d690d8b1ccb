// What was measured of a run: metrics of held-out panoramas, seams between blocks, refined poses, and movers.

/** @import { Findings, HeldOutMetrics, MovedCamera, MoverShare, RunPage, Seam } from "../shared/messages.js" */
/** @import { Choose } from "./run.js" */
import { get, snapshot, urlOf } from "panolog/shared/api.js";
import { byId, childrenOf, el, table } from "panolog/shared/dom.js";
import { count, fixed, METRICS, sentence } from "panolog/shared/format.js";

const MEANING =
  "PSNR is how far colours are off, in decibels: six more are half the error. " +
  "SSIM compares structure, 1 is equal; LPIPS what a network sees, 0 is equal. WS-PSNR and WS-SSIM count each pixel " +
  "by the area that it has on the sphere, because a panorama enlarges what is above and below.";
const OPEN = 24; // rows up to which a table is open

/** @param {...import("../shared/dom.js").Child} text */
const note = (...text) => el("p", { class: "muted small note" }, ...text);

/** A table that is closed while it is long. @param {string} label @param {HTMLTableElement} content @param {number} rows */
const listed = (label, content, rows) =>
  el(
    "details",
    { open: rows <= OPEN },
    el("summary", {}, label),
    el("div", { class: "scroll tall", tabindex: 0, role: "region", "aria-label": label }, content),
  );

/** @param {number} number @param {string} what */
const counted = (number, what) => `${count(number)} ${what}${number === 1 ? "" : "s"}`;

/** The metrics that there are, as text. @param {Record<string, number | null>} values @param {string} [prefix] of their names */
const metricsText = (values, prefix = "") =>
  METRICS.flatMap(({ key, label, unit, digits }) => {
    const value = values[prefix + key] ?? null;
    return value === null ? [] : [`${label} ${fixed(value, digits)}${unit === "dB" ? " dB" : ""}`];
  }).join(", ");

/** @param {HeldOutMetrics} metrics @param {Set<string>} pictured @param {Choose} choose */
function quality({ mean, views, lpips_reason: reason, unmeasured }, pictured, choose) {
  if (unmeasured) return [note(sentence(unmeasured))];
  const rows = Object.entries(views);
  const [all, fitted] = [metricsText(mean), metricsText(mean, "cc_")];
  /** @param {[string, Record<string, number | null>]} row */
  const name = ([view]) =>
    pictured.has(view)
      ? el("button", { type: "button", class: "row-name", on: { click: () => choose.view(view) } }, view)
      : view;
  return [
    all && note(`On average ${all}.`, fitted && ` After a fit of each render's colours ${fitted}.`),
    note(MEANING),
    reason && !snapshot && note(reason),
    rows.length > 0 &&
      listed(
        counted(rows.length, "held-out panorama"),
        table(rows, [
          ["Panorama", name],
          ...METRICS.map(
            ({ key, label, digits }) =>
              /** @type {const} */ ([
                label,
                (/** @type {typeof rows[number]} */ [, values]) => fixed(values[key], digits),
                "number",
              ]),
          ),
        ]),
        rows.length,
      ),
  ];
}

/** The pictures of a face, if it has some. @param {string} path @param {Seam} face @param {string[]} pictures */
function faceFigures(path, { blocks: [below, above], seam }, pictures) {
  const parts = {
    truth: "Photograph",
    merged: "Model",
    below: `Block ${below}, Stage I elsewhere`,
    above: `Block ${above}, Stage I elsewhere`,
  };
  const names = Object.entries(parts).map(
    ([name, label]) => /** @type {const} */ ([`seam-${below}-${above}-${name}.jpg`, label]),
  );
  const line = `seam-${below}-${above}-face.png`;
  if (![line, ...names.map(([name]) => name)].every((name) => pictures.includes(name))) return null;
  /** @param {string} name @param {string} alt @param {string | null} kind */
  const picture = (name, alt, kind = null) => el("img", { src: urlOf(`${path}/findings/${name}`), alt, class: kind });
  return el(
    "div",
    { class: "face" },
    el("h3", {}, `Blocks ${below} and ${above}: seam ${fixed(seam)}`),
    el("label", { class: "small" }, el("input", { type: "checkbox", class: "mark" }), " Mark the face"),
    el(
      "div",
      { class: "strips" },
      names.map(([name, label]) =>
        el("figure", {}, el("div", {}, picture(name, label), picture(line, "", "line")), el("figcaption", {}, label)),
      ),
    ),
  );
}

/** @param {string} path @param {Findings} found */
function seams(path, { seams: faces, colors, pictures }) {
  /** @param {Seam} face */
  const name = (face) => [
    el("span", { class: "chip", style: `background: ${colors[faces.indexOf(face)] ?? "var(--line)"}` }),
    face.blocks.join(" | "),
  ];
  return [
    note(
      "How much more the error of the model steps at a face between two blocks than along planes within them, divided by the same of the Stage I model, which has no blocks: at 1 a face is as invisible as any other place.",
    ),
    ...faces.map((face) => faceFigures(path, face, pictures)),
    listed(
      counted(faces.length, "face"),
      table(faces, [
        ["Blocks", name, "name"],
        ["Seam", ({ seam }) => fixed(seam), "number"],
        ["Step", ({ merged }) => fixed(merged.step, 4), "number"],
        ["Step within blocks", ({ merged }) => fixed(merged.step_floor, 4), "number"],
        ["Ratio in Stage I", ({ coarse }) => fixed(coarse.step_ratio), "number"],
        ["Error", ({ merged }) => fixed(merged.error, 4), "number"],
        ["Error within blocks", ({ merged }) => fixed(merged.error_floor, 4), "number"],
        ["Difference in colour", ({ difference }) => fixed(difference.color, 4), "number"],
        ["Difference in depth", ({ difference }) => fixed(difference.depth, 4), "number"],
        ["Difference in opacity", ({ difference }) => fixed(difference.opacity, 4), "number"],
      ]),
      faces.length,
    ),
  ];
}

/** @param {readonly MovedCamera[]} moves @param {HeldOutMetrics | null} metrics */
function poses(moves, metrics) {
  const bounded = moves.filter((camera) => camera.at_bound);
  const pixels = moves.reduce((sum, camera) => sum + camera.pixels, 0) / moves.length;
  const fit = metrics?.pose_fit?.mean;
  return [
    note(
      `Refining the poses of ${counted(moves.length, "camera")} moved what they see by ${fixed(pixels)} pixels on average.`,
      bounded.length > 0 &&
        ` ${count(bounded.length)} would have moved farther than their bound: look at ${bounded[0].name}.`,
      fit &&
        ` Stage I does not refine held-out panoramas. At the poses that fit the finished model best, ${fixed(fit.pixels)} pixels away on average, they have ${metricsText(fit)}; as they are ${metricsText({ psnr: metrics.mean.psnr ?? null })}.`,
    ),
    listed(
      `${counted(moves.length, "camera")}, the farthest first`,
      table(moves, [
        ["Panorama", ({ name }) => name],
        ["Pixels", (camera) => fixed(camera.pixels), "number"],
        ["Moved", ({ moved }) => fixed(moved, 4), "number"],
        ["Turned, degrees", ({ turned }) => fixed(turned, 3), "number"],
        ["At its bound", ({ at_bound: bound }) => (bound ? "yes" : "–")],
      ]),
      moves.length,
    ),
  ];
}

/** @param {string} path @param {readonly MoverShare[]} all @param {string[]} pictures */
function movers(path, all, pictures) {
  const found = all.filter(({ share }) => share > 0).length;
  const part = all.reduce((sum, { share }) => sum + share, 0) / all.length;
  const figures = all.map(({ name, share }, i) => {
    const file = `mover-${i}.jpg`;
    if (!pictures.includes(file)) return null;
    const caption = el("figcaption", {}, el("b", {}, name), ` · ${fixed(100 * share, 1)} %`);
    return el(
      "figure",
      {},
      el("img", { src: urlOf(`${path}/findings/${file}`), alt: `${name}, its movers tinted` }),
      caption,
    );
  });
  return [
    note(
      "What single training panoramas show and those around them do not, such as passers-by, is left out of the training. ",
      found
        ? `${count(found)} of ${counted(all.length, "panorama")} have some, ${fixed(100 * part)} % of all that they show.`
        : `None of ${counted(all.length, "panorama")} has any.`,
    ),
    el("div", { class: "movers" }, figures),
  ];
}

/** Fills a card, or hides it with the link to it. @param {string} id @param {import("../shared/dom.js").Child[] | false} parts */
function fill(id, parts) {
  const card = byId(id);
  card.hidden = byId(`to-${id}`).hidden = !parts;
  for (const child of childrenOf(card).slice(1)) child.remove();
  if (parts) card.append(...parts.flatMap((part) => (part ? [part] : [])));
}

/** @param {string} path of the run below /api @param {Choose} choose */
export function findings(path, choose) {
  let version = "";
  return {
    /** @param {RunPage} run */
    async update({ result }) {
      if (result.findings === version) return;
      version = result.findings;
      /** @type {[Findings, { views: { name: string }[] }] | null} */
      const both = await Promise.all([get(`${path}/findings`), get(`${path}/views`)]).catch(() => null);
      if (!both) return;
      const [found, { views }] = both;
      fill("quality", found.metrics !== null && quality(found.metrics, new Set(views.map(({ name }) => name)), choose));
      fill("seams", found.seams.length > 0 && seams(path, found));
      fill("poses", found.moves.length > 0 && poses(found.moves, found.metrics));
      fill("movers", found.movers.length > 0 && movers(path, found.movers, found.pictures));
    },
  };
}
