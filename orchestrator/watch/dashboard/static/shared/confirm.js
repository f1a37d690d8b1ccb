// The dialog in which an action is confirmed, on every page that has actions.

import { messageOf } from "panolog/shared/api.js";
import { byId, el, setText } from "panolog/shared/dom.js";

/** The dialog, which the first call makes. */
function made() {
  const known = byId("confirm", HTMLDialogElement);
  if (known) return known;
  const menu = el(
    "menu",
    {},
    el("button", { value: "cancel" }, "Cancel"),
    el("button", { id: "confirm-yes", value: "yes", type: "button" }),
  );
  const text = [
    el("h2", { id: "confirm-title" }),
    el("p", { id: "confirm-text" }),
    el("p", { id: "confirm-error", class: "error", role: "alert" }),
  ];
  const dialog = el(
    "dialog",
    { id: "confirm", "aria-labelledby": "confirm-title" },
    el("form", { method: "dialog" }, text, menu),
  );
  document.body.append(dialog);
  return dialog;
}

/**
 * Requests a confirmation in the dialog, which also shows errors of the action.
 * @param {[string, string, string]} texts title, text and button
 * @param {boolean} danger
 * @param {() => Promise<void>} act
 */
export function confirm([title, text, yes], danger, act) {
  const dialog = made();
  const [button, error] = [byId("confirm-yes"), byId("confirm-error")];
  setText(byId("confirm-title"), title);
  setText(byId("confirm-text"), text);
  setText(button, yes);
  setText(error, "");
  button.className = danger ? "danger" : "primary";
  button.onclick = async () => {
    try {
      await act();
      dialog.close();
    } catch (failure) {
      setText(error, messageOf(failure));
    }
  };
  dialog.showModal();
}
