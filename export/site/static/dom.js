// The page's elements.

/** @template {Element} [T=HTMLElement] @param {string} id @returns {T} */
export const at = (id) => /** @type {T} */ (/** @type {unknown} */ (document.getElementById(id)));

/** @param {string} id @returns {HTMLButtonElement} */
export const button = (id) => at(id);

/** @param {string} id @returns {HTMLInputElement} */
export const input = (id) => at(id);

/** @param {string} id @param {boolean} pressed */
export const press = (id, pressed) => at(id).setAttribute("aria-pressed", String(pressed));

/** @param {string} id */
export const pressed = (id) => at(id).getAttribute("aria-pressed") === "true";

/** Whether the user wants no movement but their own. */
export const still = matchMedia("(prefers-reduced-motion: reduce)");

export const number = new Intl.NumberFormat("en");

/** @param {string} text @param {boolean} [failed]  Says how loading goes; nothing once all is there. */
export function say(text, failed = false) {
  at("message").textContent = text;
  at("state").hidden = !text;
  at("state").classList.toggle("failed", failed);
}

/** @param {string} name @param {BlobPart} content @param {string} type  Gives the user a file. */
export function download(name, content, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** @param {HTMLElement} element  Copies its text, or selects it where the browser does not allow that. */
export async function copy(element) {
  try {
    await navigator.clipboard.writeText(element.textContent ?? "");
  } catch {
    getSelection()?.selectAllChildren(element);
  }
}

const SECTIONS = [
  ["list", "cameras"],
  ["more", "extras"],
  ["how", "help"],
];

/** @param {string} section  Opens or closes a section, and closes the other one. Returns whether it is open. */
export function toggle(section) {
  const open = at(section).hidden;
  for (const [opener, part] of SECTIONS) {
    at(part).hidden = !(open && part === section);
    at(opener).setAttribute("aria-expanded", String(open && part === section));
  }
  return open;
}

/** Closes what is open, and gives its button the focus. Returns whether there was anything. */
export function close() {
  for (const [opener, part] of SECTIONS) {
    if (at(part).hidden) continue;
    toggle(part);
    at(opener).focus();
    return true;
  }
  return false;
}
