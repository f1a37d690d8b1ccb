// All talk with the server.

/** JSON from a path below /api. Throws an Error with the server's own line, and its status. */
export async function get(path) {
  return answer(await fetch(`/api/${path}`, { headers: { Accept: "application/json" } }));
}

export async function post(path, body) {
  const headers = { "Content-Type": "application/json", "X-PanoLOG": "1" };
  return answer(await fetch(`/api/${path}`, { method: "POST", headers, body: JSON.stringify(body) }));
}

async function answer(response) {
  const content = await response.json().catch(() => ({}));
  if (response.ok) return content;
  throw Object.assign(new Error(content.error ?? `the server answered ${response.status}`), { status: response.status });
}

const AGAIN = 2000; // milliseconds until a refused stream is tried again
const HIDDEN = 60_000; // after which a page that nobody looks at lets go of its stream

/**
 * Server-sent events that come back by themselves. Every connection begins with the whole truth, so nothing that
 * was missed needs to be asked for.
 *
 * `handlers` has a function for each kind of event, `open`, and `lost`, which is told whether the server refused.
 */
export function stream(query, handlers) {
  let source = null;
  let timer = null;
  const open = () => {
    clearTimeout(timer);
    source = new EventSource(`/api/stream${query}`);
    source.onopen = () => handlers.open();
    source.onerror = () => {
      const refused = source.readyState === EventSource.CLOSED; // otherwise the browser tries again itself
      handlers.lost(refused);
      if (refused) timer = setTimeout(open, AGAIN);
    };
    for (const [kind, handle] of Object.entries(handlers)) {
      if (kind !== "open" && kind !== "lost") source.addEventListener(kind, (event) => handle(JSON.parse(event.data)));
    }
  };
  // A browser has few connections to one server: pages in the background give theirs back after a while.
  document.addEventListener("visibilitychange", () => {
    clearTimeout(timer);
    if (document.hidden) {
      timer = setTimeout(() => { source.close(); source = null; }, HIDDEN);
    } else if (source === null || source.readyState === EventSource.CLOSED) open();
  });
  open();
}
