// All communication with the server; in a report, what it holds in place of one.

import { byId, setMessage } from "panolog/shared/dom.js";
import { clock } from "panolog/shared/format.js";

/**
 * What a report holds: answers and URLs of pictures by their paths below /api, and the messages of the stream. Null in the dashboard.
 * @type {{answers: Record<string, any>, stream: Record<string, any>} | null}
 */
export const snapshot = JSON.parse(document.getElementById("snapshot")?.textContent ?? "null");

/** The URL of a picture. @param {string} path below /api @returns {string | null} */
export const urlOf = (path) => (snapshot ? (snapshot.answers[path] ?? null) : `/api/${path}`);

/** An answer that is an error, with the server's own line. */
class ApiError extends Error {
  /** @param {string} message @param {number} status */
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

/** The message of whatever was thrown. @param {unknown} error */
export const messageOf = (error) => (error instanceof Error ? error.message : String(error));

/** The HTTP status of an error, undefined if no server answered. @param {unknown} error */
export const statusOf = (error) => (error instanceof ApiError ? error.status : undefined);

/** JSON from a path below /api. Throws an ApiError. @param {string} path @returns {Promise<any>} */
export async function get(path) {
  if (snapshot) {
    if (!(path in snapshot.answers)) throw new ApiError("This report does not hold it: the dashboard shows it.", 404);
    return snapshot.answers[path];
  }
  return answer(await fetch(`/api/${path}`, { headers: { Accept: "application/json" } }));
}

/** @param {string} path @param {object} body @returns {Promise<any>} */
export async function post(path, body) {
  const headers = { "Content-Type": "application/json", "X-PanoLOG": "1" };
  return answer(await fetch(`/api/${path}`, { method: "POST", headers, body: JSON.stringify(body) }));
}

/** @param {Response} response */
async function answer(response) {
  const content = await response.json().catch(() => ({}));
  if (response.ok) return content;
  throw new ApiError(content.error ?? `the server answered ${response.status}`, response.status);
}

const RETRY = 250; // milliseconds until a refused stream is opened again
const HIDDEN = 60_000; // after which a page in the background closes its stream
const QUIET = 1500; // without a connection before the page says so

/**
 * The line that says since when the page is not up to date.
 * @param {(time: number | null) => void} changed called with when the connection was lost, in seconds since the epoch, or null
 * @param {() => string} known what the page knows without a connection
 */
export function connectionLine(changed, known) {
  const line = byId("connection");
  /** @type {number | undefined} */
  let timer;
  return {
    good() {
      clearTimeout(timer);
      timer = undefined;
      if (line.hidden) return;
      line.hidden = true;
      changed(null);
    },
    /** @param {string} [why] if there is a connection, but no news */
    lost(why) {
      const time = Date.now() / 1000;
      timer ??= setTimeout(() => {
        setMessage(line, why ? `${why}, since ${clock(time)}` : `Connection lost at ${clock(time)}${known()}`);
        changed(time);
      }, QUIET);
    },
  };
}

/**
 * Server-sent events that reconnect by themselves. Every connection begins with a complete message, so nothing has to be
 * requested again.
 * @param {string} query
 * @param {() => void} open called when connected
 * @param {(refused: boolean) => void} lost called when disconnected, or refused by the server
 * @param {Record<string, (message: any) => void>} handlers by kind of event
 */
export function stream(query, open, lost, handlers) {
  if (snapshot) {
    open();
    for (const [kind, message] of Object.entries(snapshot.stream)) handlers[kind](message);
    return;
  }
  /** @type {EventSource | null} */
  let source = null;
  /** @type {number | undefined} */
  let timer;
  const connect = () => {
    clearTimeout(timer);
    const opened = new EventSource(`/api/stream${query}`);
    source = opened;
    opened.onopen = open;
    opened.onerror = () => {
      const refused = opened.readyState === EventSource.CLOSED; // otherwise the browser retries itself
      lost(refused);
      if (refused) timer = setTimeout(connect, RETRY);
    };
    for (const [kind, handle] of Object.entries(handlers))
      opened.addEventListener(kind, (event) => handle(JSON.parse(event.data)));
  };
  // A browser has few connections to one server: pages in the background release theirs after a while.
  document.addEventListener("visibilitychange", () => {
    clearTimeout(timer);
    if (document.hidden) {
      timer = setTimeout(() => {
        source?.close();
        source = null;
      }, HIDDEN);
    } else if (source === null || source.readyState === EventSource.CLOSED) connect();
  });
  connect();
}
