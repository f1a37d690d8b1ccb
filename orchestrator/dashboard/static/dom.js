// Elements made of plain values. Text is always text: nothing that a scene or a log line says becomes markup.

/** An element. Properties: `on` holds listeners, `class` and all else attributes; null and false are left out. */
export function el(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "on") for (const [event, listener] of Object.entries(value)) node.addEventListener(event, listener);
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

export const byId = (id) => document.getElementById(id);

/** Sets a text only if it is another one, so that nothing flickers and selections survive. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** The word for a status with its colour; the word alone is enough to understand it. */
export function pill(status) {
  return el("span", { class: "pill", "data-status": status }, status);
}

export function setPill(node, status) {
  node.dataset.status = status;
  setText(node, status);
}

/** A progress bar with a name for those who cannot see it. */
export function bar(share, label) {
  return el("progress", { max: 1, value: Math.min(Math.max(share ?? 0, 0), 1), "aria-label": label });
}

/** The same list of children in place, by key: made where they are new, removed where they are gone. */
export function reconcile(parent, items, key, make, update) {
  const present = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  let cursor = parent.firstElementChild;
  for (const item of items) {
    const id = String(key(item));
    let node = present.get(id);
    present.delete(id);
    if (!node) {
      node = make(item);
      node.dataset.key = id;
    }
    if (node === cursor) cursor = cursor.nextElementSibling;
    else parent.insertBefore(node, cursor);
    update(node, item);
  }
  for (const node of present.values()) node.remove();
}

/** A colour token of the style sheet, as the present theme has it. */
export function token(name) {
  const probe = el("i", { class: "probe" });
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const color = getComputedStyle(probe).color;
  probe.remove();
  return color;
}

const SHARE = 10; // of this many parts of the time, work that is repeated takes one at most
const LONGEST = 5000; // milliseconds

/**
 * Calls `action` at most once in `wait` milliseconds, and always after the last call. What takes long on this
 * machine is called less often, so that the page stays quick.
 */
export function throttled(action, wait) {
  let timer = null;
  let again = false;
  let cost = 0;
  const fire = () => {
    timer = null;
    if (again) call();
  };
  const call = async () => {
    again = timer !== null;
    if (again) return;
    timer = setTimeout(fire, Math.max(wait, Math.min(SHARE * cost, LONGEST)));
    const began = performance.now();
    await action();
    cost = performance.now() - began;
  };
  return call;
}
