// Rows of a list that are dragged by a handle to another place, by mouse, pen or finger.

/** Pixels from the edge of the window within which the page is scrolled, and by how many. */
const [EDGE, SCROLL] = [48, 12];

/** The rows among which a row is moved. @param {HTMLElement} row */
const rowsOf = (row) =>
  /** @type {HTMLElement[]} */ ([...(row.parentElement?.querySelectorAll(":scope > .waits") ?? [])]);

/** The place among the other rows at a height in the window. @param {HTMLElement} row @param {number} y */
function placeAt(row, y) {
  const others = rowsOf(row).filter((one) => one !== row);
  const after = others.findIndex((one) => y < one.getBoundingClientRect().top + one.offsetHeight / 2);
  return after < 0 ? others.length : after;
}

/** Shows where the row would go. @param {HTMLElement} row @param {number} place */
function mark(row, place) {
  const others = rowsOf(row).filter((one) => one !== row);
  const own = rowsOf(row).indexOf(row);
  others.forEach((one, index) => {
    one.classList.toggle("drop-above", index === place && place !== own);
    one.classList.toggle("drop-below", index === place - 1 && place === others.length && place !== own);
  });
}

/**
 * Lets a row be dragged while it has the class "waits"; Escape leaves it where it is.
 * @param {HTMLElement} handle
 * @param {HTMLElement} row
 * @param {(key: string, place: number) => void} drop gets the row's key and its new place among those that wait
 */
export function draggable(handle, row, drop) {
  /** @param {PointerEvent} down */
  function start(down) {
    if (down.button || !row.classList.contains("waits")) return;
    down.preventDefault(); // no selection of text
    handle.setPointerCapture(down.pointerId);
    const ends = new AbortController();
    const options = { signal: ends.signal };
    const end = () => {
      ends.abort();
      row.classList.remove("dragged");
      row.style.translate = "";
      for (const one of rowsOf(row)) one.classList.remove("drop-above", "drop-below");
    };
    row.classList.add("dragged");
    handle.addEventListener(
      "pointermove",
      (move) => {
        const { clientY: y, pageY } = move;
        row.style.translate = `0 ${pageY - down.pageY}px`;
        if (y < EDGE || y > innerHeight - EDGE) scrollBy(0, y < EDGE ? -SCROLL : SCROLL);
        mark(row, placeAt(row, y));
      },
      options,
    );
    handle.addEventListener(
      "pointerup",
      (up) => {
        const waits = row.classList.contains("waits"); // it may have started meanwhile
        const place = placeAt(row, up.clientY);
        end();
        if (waits) drop(row.dataset.key ?? "", place);
      },
      options,
    );
    handle.addEventListener("lostpointercapture", end, options);
    addEventListener("keydown", (key) => key.key === "Escape" && end(), options);
  }
  handle.addEventListener("pointerdown", start);
}
