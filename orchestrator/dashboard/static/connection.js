// The quiet line that says when the page is not up to date.

import { byId, setText } from "./dom.js";

const PATIENCE = 1500; // milliseconds without a connection before it is worth a word

export function connectionLine() {
  const line = byId("connection");
  let timer = null;
  return {
    good() {
      clearTimeout(timer);
      timer = null;
      line.hidden = true;
    },
    lost(text = "Connection lost, trying again …") {
      timer ??= setTimeout(() => {
        setText(line, text);
        line.hidden = false;
      }, PATIENCE);
    },
  };
}
