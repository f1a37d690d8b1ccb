"""A browser whose pages look the same on every machine, and pictures of what it shows."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import cv2
import numpy as np
from playwright.sync_api import Browser, Page

from tests.orchestrator.dashboard.browser import PHONE, chromium
from tests.visual.compare import Picture
from tests.visual.fixed import NOW, fixed_fonts

Theme = Literal["light", "dark"]

_FLAGS = ("--font-render-hinting=none", "--disable-lcd-text", "--force-color-profile=srgb")
# Resolves when all pictures are there and nothing of the page has changed for so many milliseconds.
_QUIET = """(quiet) => new Promise((resolve) => {
  let last = performance.now();
  const observer = new MutationObserver(() => { last = performance.now(); });
  observer.observe(document, {subtree: true, childList: true, attributes: true, characterData: true});
  const look = () => {
    const loads = [...document.images].some((image) => !image.complete) || document.fonts.status !== "loaded";
    if (loads || performance.now() - last < quiet) return setTimeout(look, 30);
    observer.disconnect();
    resolve();
  };
  look();
})"""
_RENAME = """([from, to]) => {
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode;
    if (node.data.includes(from)) node.data = node.data.replaceAll(from, to);
  }
}"""


@contextmanager
def fixed_browser() -> Iterator[Browser]:
    """Chromium with fonts of ours; skips the test where there is none."""
    with fixed_fonts() as environment, chromium(_FLAGS, environment) as browser:
        yield browser


@contextmanager
def fixed_page(browser: Browser, width: int) -> Iterator[Page]:
    """A light page of that width where the time stands still and nothing moves."""
    size: Any = {"width": width, "height": 844 if width == PHONE else 900}
    context = browser.new_context(
        viewport=size,
        color_scheme="light",
        reduced_motion="reduce",
        locale="en-GB",
        timezone_id="UTC",
        has_touch=width == PHONE,
    )
    page = context.new_page()
    page.clock.set_fixed_time(NOW)
    try:
        yield page
    finally:
        context.close()


def wait_until_quiet(page: Page, milliseconds: float = 400) -> None:
    """Waits until all pictures are loaded and nothing has changed for so long."""
    page.evaluate(_QUIET, milliseconds)


def rename(page: Page, what: str, name: str) -> None:
    """Replaces a text that differs from test to test, such as a temporary folder, on the whole page."""
    page.evaluate(_RENAME, [what, name])


def screenshot(page: Page, *, whole: bool = True) -> Picture:
    """The whole page, or what the window shows of it."""
    data = page.screenshot(full_page=whole, animations="disabled", caret="hide")
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)
