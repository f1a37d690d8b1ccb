// What a report begins with: the name, a picture, the model in 3D, and a sentence on its quality. The rest is folded.

/** @import { Findings, RunPage } from "../shared/messages.js" */
import { get } from "panolog/shared/api.js";
import { byId, el, first, setMessage } from "panolog/shared/dom.js";
import { count, decibel, fixed, sentence } from "panolog/shared/format.js";

const MADE =
  "Stage I trains the whole place at once. Scoring finds which panoramas matter to which block, " +
  "Stage II trains each block with those, and the merge puts the blocks together.";
const OPEN = ["preparation", "views"]; // cards that are not folded: the first folds itself

/** A button that shows and hides what follows the heading of a card. @param {HTMLElement} card */
function fold(card) {
  const header = first("header", card);
  const name = first("h2", header).textContent ?? "";
  const button = el("button", { type: "button", class: "plain fold", "aria-label": `Show ${name}` }, "Show");
  /** @param {boolean} folded */
  const set = (folded) => {
    card.classList.toggle("folded", folded);
    button.setAttribute("aria-expanded", String(!folded));
    button.textContent = folded ? "Show" : "Hide";
    button.setAttribute("aria-label", `${button.textContent} ${name}`);
    window.dispatchEvent(new Event("resize")); // charts fill what they are in
  };
  button.addEventListener("click", () => set(!card.classList.contains("folded")));
  header.append(button);
  set(true);
}

/** Facts and stages as a card of their own, after the picture. */
function made() {
  const card = el(
    "section",
    { id: "made", class: "card", "aria-labelledby": "made-title" },
    el("header", {}, el("h2", { id: "made-title" }, "How it was made")),
    byId("facts"),
    byId("stages"),
    el("p", { class: "muted small note" }, MADE),
  );
  first(".hero").after(card);
}

/** What is next to the report. @param {RunPage["result"]} result */
function links({ view, sog, model }) {
  /** @param {string} href @param {string} label @param {string} kind */
  const link = (href, label, kind, download = false) =>
    el("a", { href, class: kind, download: download ? "" : null }, label);
  byId("actions").replaceChildren(
    ...[
      view && link("view.html", "Open in 3D", "button primary"),
      sog && link("web/model.sog", "Save for viewers (SOG)", "button", true),
      model && link("point_cloud.ply", "Save for training (PLY)", "button", true),
    ].filter((part) => part !== false),
  );
}

/** @param {string} path of the run below /api @param {RunPage} run */
export async function report(path, { summary, result }) {
  byId("scene").hidden = true;
  byId("preparation-details").removeAttribute("open");
  made();
  links(result);
  for (const card of document.querySelectorAll("section.card")) {
    if (card instanceof HTMLElement && !OPEN.includes(card.id)) fold(card);
  }
  /** @type {Findings} */
  const { metrics } = await get(`${path}/findings`);
  if (metrics?.unmeasured) setMessage(byId("verdict"), sentence(metrics.unmeasured));
  const psnr = summary.metrics?.psnr ?? null;
  if (psnr === null) return;
  const seen = Object.keys(metrics?.views ?? {}).length;
  const off = `${fixed(100 * 10 ** (-psnr / 20), 1)} % of full brightness on average`;
  setMessage(
    byId("verdict"),
    `From ${count(seen)} places that the training has not seen, the model differs from the ` +
      `photographs by ${off} (PSNR ${decibel(psnr)}; more is better).`,
  );
}
