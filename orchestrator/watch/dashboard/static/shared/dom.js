// Elements made of plain values. Text is always text: nothing from a scene or a log becomes markup.

/** @typedef {Node | string | null | undefined | false} Child */

/**
 * An element. Properties: `on` holds listeners, `class` and all else attributes; null and false are left out.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, any>} properties
 * @param {...(Child | Child[])} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function el(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "on")
      for (const [event, listener] of Object.entries(value))
        node.addEventListener(event, /** @type {any} */ (listener));
    else if (value !== null && value !== undefined && value !== false)
      node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

/** An element of a drawing; what is undefined or false is left out. @param {string} tag @param {Record<string, string | number | false | undefined>} attributes @param {...(Node | string)} children */
export function svg(tag, attributes, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes))
    if (value !== undefined && value !== false) node.setAttribute(name, String(value));
  node.append(...children);
  return node;
}

/** The element of the page with an id. @type {<T extends HTMLElement = HTMLElement>(id: string, kind?: new () => T) => T} */
export const byId = (id) => /** @type {any} */ (document.getElementById(id));

/** The first element below a node that a selector matches. @type {<T extends HTMLElement = HTMLElement>(selector: string, node?: ParentNode) => T} */
export const first = (selector, node = document) => /** @type {any} */ (node.querySelector(selector));

/** The child elements of a node. @param {Element} node */
export const childrenOf = (node) => /** @type {HTMLElement[]} */ ([...node.children]);

/** Sets a text only if it differs, so that nothing flickers and selections survive. @param {Node} node @param {string} text */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Sets a text and hides the element while there is none. @param {HTMLElement} node @param {string} text */
export function setMessage(node, text) {
  setText(node, text);
  node.hidden = !text;
}

/** A status as a word on its colour; the word alone is enough to understand it. @param {string} status */
export function pill(status) {
  return el("span", { class: "pill", "data-status": status }, status);
}

/** @param {HTMLElement} node @param {string} status @param {string} label what people read */
export function setPill(node, status, label = status) {
  node.dataset.status = status;
  setText(node, label);
}

/** The status by which a run has its colour: one that waits is not at work. @param {{status: string, label: string}} run */
export const toneOf = ({ status, label }) => (label.startsWith("waiting") ? "paused" : status);

/** A progress bar; its label is for screen readers. @param {number} share @param {string} label */
export function bar(share, label) {
  return el("progress", { max: 1, value: share, "aria-label": label });
}

/** @param {Element} node @param {number} share @param {string} label */
export function setBar(node, share, label) {
  /** @type {HTMLProgressElement} */ (node).value = share;
  node.setAttribute("aria-label", label);
}

/**
 * Updates the children of an element in place, by key: made for new items, removed for those that are gone.
 * @template T
 * @param {Element} parent
 * @param {readonly T[]} items
 * @param {(item: T) => string} key
 * @param {(item: T) => HTMLElement} make
 * @param {(node: HTMLElement, item: T) => void} update
 */
export function reconcile(parent, items, key, make, update) {
  const present = new Map(childrenOf(parent).map((child) => [child.dataset.key, child]));
  let cursor = parent.firstElementChild;
  for (const item of items) {
    const id = key(item);
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

/**
 * Replaces the children of an element if `key` differs from that of the last call. A button or link that has the focus keeps it.
 * @param {HTMLElement} parent
 * @param {unknown} key
 * @param {() => Child[]} content
 */
export function replaceIfChanged(parent, key, content) {
  const text = JSON.stringify(key);
  if (parent.dataset.key === text) return;
  parent.dataset.key = text;
  const focused = parent.contains(document.activeElement) ? document.activeElement?.textContent : null;
  parent.replaceChildren(...content().filter((child) => child !== null && child !== undefined && child !== false));
  if (focused)
    /** @type {HTMLElement[]} */ ([...parent.querySelectorAll("button, a")])
      .find((node) => node.textContent === focused)
      ?.focus({ preventScroll: true });
}

const ROWS = 2_000; // of a table at most

/**
 * A table. A column is its label, the content of its cells, and the class of both, such as "number".
 * @template T
 * @param {readonly T[]} items
 * @param {readonly (readonly [string, (item: T) => Child | Child[], string?])[]} columns
 */
export function table(items, columns) {
  const heads = columns.map(([label, , kind]) => el("th", { scope: "col", class: kind }, label));
  const rows = items.slice(0, ROWS).map((item) =>
    el(
      "tr",
      {},
      columns.map(([, content, kind]) => el("td", { class: kind }, content(item))),
    ),
  );
  return el("table", {}, el("thead", {}, el("tr", {}, heads)), el("tbody", {}, rows));
}

/**
 * The headings of a table, as buttons that sort it.
 * @param {string} table selector
 * @param {{key: string, label: string, number?: boolean}[]} columns
 * @param {(key: string) => void} sortBy
 */
export function addHeadings(table, columns, sortBy) {
  first(`${table} thead tr`).append(
    ...columns.map(({ key, label, number }) => {
      const button = el("button", { type: "button", class: "sorter", on: { click: () => sortBy(key) } }, label);
      return el("th", { scope: "col", class: number ? "number" : null, "data-column": key }, button);
    }),
  );
}

/** Marks the column that a table is sorted by. @param {string} table selector @param {string} key @param {boolean} down */
export function markSorted(table, key, down) {
  for (const head of childrenOf(first(`${table} thead tr`))) {
    if (head.matches("th"))
      head.setAttribute("aria-sort", head.dataset.column !== key ? "none" : down ? "descending" : "ascending");
  }
}

/**
 * Compares two values of a column, unknown ones last in either direction; 0 if they are equal or both unknown.
 * @param {string | number | null | undefined} x
 * @param {string | number | null | undefined} y
 * @param {boolean} down
 */
export function compare(x, y, down) {
  const [unknownX, unknownY] = [x === null || x === undefined || x === "", y === null || y === undefined || y === ""];
  if (unknownX || unknownY) return Number(unknownX) - Number(unknownY);
  const order = typeof x === "string" ? x.localeCompare(String(y)) : Number(x) - Number(y);
  return down ? -order : order;
}

/** Whether a text contains all words of a search. @param {string} text @param {string} search */
export function matches(text, search) {
  return search
    .toLowerCase()
    .split(/\s+/)
    .every((word) => text.toLowerCase().includes(word));
}

/** A colour of the style sheet in the current theme, by the name of its property. @param {string} name */
export function token(name) {
  const probe = el("i", { class: "probe" });
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const color = getComputedStyle(probe).color;
  probe.remove();
  return color;
}

const SHARE = 10; // repeated work takes at most one of this many parts of the time
const LONGEST = 5000; // milliseconds

/**
 * Calls `action` at most once in `wait` milliseconds, and always after the last call. What takes long on this
 * machine is called less often, so that the page stays responsive.
 * @param {() => unknown} action
 * @param {number} wait
 */
export function throttled(action, wait) {
  /** @type {number | null} */
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
