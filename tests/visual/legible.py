"""What makes a page hard to read: text with too little contrast, text over text, and sideways scrolling."""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page

from tests.visual.browser import Theme, screenshot, wait_until_quiet
from tests.visual.compare import Picture

_TEXT = Path(__file__).with_name("text.js").read_text()
_SIDEWAYS = Path(__file__).with_name("sideways.js").read_text()
_UNHIDE = "document.adoptedStyleSheets = document.adoptedStyleSheets.slice(0, -1)"
_STRAY = 10  # percent of the pixels under a text that may be of something else, such as a grid line
_THIN = 0.7  # how much of its colour the darkest pixel of a thin letter has at least
_OVERLAP = 0.3  # of the area of a text, from which on it is over another

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Text:
    """A text that can be seen."""

    text: str
    boxes: list[tuple[float, float, float, float]]  # x, y, width and height of each line, pixels of the page
    ink: tuple[float, float, float, float]  # red, green, blue of 255; opacity 0 to 1
    needed: float  # contrast that WCAG 1.4.3 requires at its size
    name: str  # class of its element
    element: int  # number of its element; -1 where only that, not the place of the text in it, is known


def sideways(page: Page) -> list[str]:
    """What makes a page wider than its window."""
    found: list[str] = page.evaluate(_SIDEWAYS)
    return found


def low_contrast(page: Page, shown: Picture | None = None, *, whole: bool = True) -> list[str]:
    """Every text that has less contrast than WCAG AA requires (2.2, 1.4.3) to the pixels that are behind it.

    These are looked at without the text, so pictures, curves and translucent layers count as they are seen. A
    text that hardly changes the pixels, because something is above it, has as much less contrast.

    Args: shown, a screenshot of the page as it is, if there is one already; whole, whether of all of it.
    """
    if shown is None:
        shown = screenshot(page, whole=whole)
    found, hidden = page.evaluate(_TEXT, True)
    assert hidden
    bare = screenshot(page, whole=whole)
    page.evaluate(_UNHIDE)
    lines = []
    for text in (Text(*one) for one in found):
        ratio = _contrast(text.ink, [(_crop(bare, box), _crop(shown, box)) for box in text.boxes])
        if ratio < text.needed - 0.005:
            lines.append(f"{ratio:.2f} of {text.needed}: {text.text!r} ({text.name})")
    return lines


def hard_to_read(page: Page, *widths: int) -> list[str]:
    """What makes an open page hard to read, at widths in pixels and in one theme after the other."""
    page.evaluate("scrollTo(0, 0)")  # else the head of the page is over some text
    found = []
    for width, theme in product(widths, get_args(Theme)):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=theme)
        wait_until_quiet(page)
        lines = [*sideways(page), *overlapping(page), *low_contrast(page)]
        found += [f"{width} pixels, {theme}: {line}" for line in lines]
    return found


def overlapping(page: Page) -> list[str]:
    """Pairs of texts of which one covers a part of the other."""
    texts = [Text(*one) for one in page.evaluate(_TEXT, False)[0]]
    lines = [(text, box) for text in texts for box in text.boxes if text.element >= 0]
    x, y, width, height = np.array([box for _, box in lines]).reshape(-1, 4).T
    element = np.array([text.element for text, _ in lines])
    one, other = np.triu_indices(len(lines), 1)
    wide = np.minimum((x + width)[one], (x + width)[other]) - np.maximum(x[one], x[other])
    high = np.minimum((y + height)[one], (y + height)[other]) - np.maximum(y[one], y[other])
    smaller = np.minimum((width * height)[one], (width * height)[other])
    covers = (wide > 0) & (high > 0) & (wide * high > _OVERLAP * smaller) & (element[one] != element[other])
    pairs = zip(one[covers], other[covers], strict=True)
    return [f"{lines[a][0].text!r} and {lines[b][0].text!r}" for a, b in pairs]


def _crop(picture: Picture, box: tuple[float, float, float, float]) -> Floats:
    """(N, 3) the pixels of a box, RGB; one white one where it is outside of the picture."""
    x, y, width, height = (round(side) for side in box)
    pixels = picture[max(y, 0) : y + max(height, 1), max(x, 0) : x + max(width, 1), ::-1].reshape(-1, 3)
    return pixels.astype(np.float64) if len(pixels) else np.full((1, 3), 255.0)


def _contrast(ink: tuple[float, ...], lines: list[tuple[Floats, Floats]]) -> float:
    """The least contrast of the lines of a text to almost all of the pixels that it is on.

    Args: lines, the pixels (N, 3) of each, without the text and with it.
    """
    ways = [ink[3] * (np.array(ink[:3]) - bare) for bare, _ in lines]
    reached = max(
        float(np.max(np.sum((shown - bare) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1)))
        for (bare, shown), way in zip(lines, ways, strict=True)
    )
    ratios = []
    for (bare, _), way in zip(lines, ways, strict=True):
        first, second = _luminance(bare + min(1.0, reached / _THIN) * way), _luminance(bare)
        ratio = (np.maximum(first, second) + 0.05) / (np.minimum(first, second) + 0.05)
        ratios.append(float(np.percentile(ratio, _STRAY)))
    return min(ratios)


def _luminance(color: Floats) -> Floats:
    """(N,) the relative luminance of sRGB colours (N, 3) of 255, as WCAG defines it."""
    part = color / 255
    linear: Any = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ [0.2126, 0.7152, 0.0722], np.float64)
