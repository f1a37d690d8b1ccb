// All settings of a run, and which differ from the defaults.

import { byId, el, setText } from "./dom.js";

const text = (value) => (value === null || value === undefined ? "none" : typeof value === "string" ? value : JSON.stringify(value));

function row(setting) {
  const name = el("td", {}, el("code", {}, setting.key), el("span", { class: "doc" }, setting.unit_or_doc));
  const value = el("td", {}, text(setting.value), setting.changed && el("span", { class: "changed" }, "changed"));
  return el("tr", { class: setting.changed ? "differs" : null }, name, value, el("td", { class: "muted" }, text(setting.default)));
}

export function settings() {
  let config = [];
  let known = null;
  const show = () => {
    const word = byId("setting-search").value.toLowerCase();
    const rows = config.filter((s) => (!byId("changed").checked || s.changed) && `${s.key} ${s.unit_or_doc}`.toLowerCase().includes(word));
    document.querySelector("#setting-table tbody").replaceChildren(...rows.map(row));
  };
  byId("changed").addEventListener("change", show);
  byId("setting-search").addEventListener("input", show);
  return {
    update(run) {
      const now = JSON.stringify(run.config);
      if (now === known) return;
      known = now;
      config = run.config;
      const versions = Object.entries(run.info?.versions ?? {}).map(([name, version]) => `${name} ${version}`);
      setText(byId("versions"), [`created ${run.info?.created ?? "?"}`, ...versions].join(" · "));
      show();
    },
  };
}
