// The machines of a run and what each does now.

import { byId, el, reconcile, setText } from "./dom.js";
import { bytes, fixed, taskLabel } from "./format.js";

const MOST = 12; // names of tasks listed for one machine

function fill(node, host) {
  const [title, device, work, numbers] = node.children;
  setText(title, host.node);
  setText(device, host.gpus?.length ? host.gpus.join(", ") : host.device || "");
  const names = host.tasks.slice(0, MOST).map(taskLabel).join(", ");
  const rest = host.tasks.length - MOST;
  setText(work, host.tasks.length ? names + (rest > 0 ? ` and ${rest} more` : "") : "idle");
  setText(numbers, host.tasks.length ? `${bytes(host.memory)} in use · ${fixed(host.rate, 1)} it/s` : "");
}

export function machines() {
  return {
    update({ nodes }) {
      const make = () => el("li", {}, el("h3"), el("span", { class: "muted small" }), el("p"), el("p", { class: "muted small" }));
      reconcile(byId("nodes"), nodes, (host) => host.node, make, fill);
      if (!nodes.length) byId("nodes").replaceChildren(el("li", { class: "empty", "data-key": "" }, "No machine has begun to work yet."));
    },
  };
}
