// The dialog in which an action is confirmed, on every page that has actions.

import { messageOf } from "./api.js";
import { byId, setText } from "./dom.js";

/**
 * Requests a confirmation in the dialog, which also shows errors of the action.
 * @param {[string, string, string]} texts title, text and button
 * @param {boolean} danger
 * @param {() => Promise<void>} act
 */
export function confirm([title, text, yes], danger, act) {
  const [dialog, button, error] = [byId("confirm", HTMLDialogElement), byId("confirm-yes"), byId("confirm-error")];
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
