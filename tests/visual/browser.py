"""A browser whose pages look the same on every machine, and pictures of what it shows."""

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from playwright.sync_api import Browser, Page

from tests.orchestrator.watch.dashboard.browser import PATIENCE_MS, chromium
from tests.visual.compare import Picture, expand
from tests.visual.fixed import NOW, fixed_fonts

Theme = Literal["light", "dark"]

_MOST_MS = 6_000  # to wait for a page to be quiet: some never are
_FLAGS = ("--font-render-hinting=none", "--disable-lcd-text", "--force-color-profile=srgb")
# Resolves when all pictures are there and nothing of the page has changed for so many milliseconds,
# or after the most milliseconds.
_QUIET = """([quiet, most]) => new Promise((resolve) => {
  const first = performance.now();
  let last = first;
  const observer = new MutationObserver(() => { last = performance.now(); });
  observer.observe(document, {subtree: true, childList: true, attributes: true, characterData: true});
  const look = () => {
    if (performance.now() - first > most) return resolve();
    const loads = [...document.images].some((image) => !image.complete) || document.fonts.status !== "loaded";
    if (loads || performance.now() - last < quiet) return setTimeout(look, 30);
    observer.disconnect();
    resolve();
  };
  look();
})"""
# Replaces a text that differs from test to test, such as a temporary folder, whenever a page shows it.
_RENAME = """
new MutationObserver(() => {
  const walker = document.createTreeWalker(document, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode;
    if (node.data.includes(%(old)s) && !node.parentElement?.closest("script")) {
      node.data = node.data.replaceAll(%(old)s, %(new)s);
    }
  }
}).observe(document, {subtree: true, childList: true, characterData: true});
"""


@contextmanager
def fixed_browser() -> Iterator[Browser]:
    """Chromium with fonts of ours; skips the test where there is none."""
    with fixed_fonts() as environment, chromium(_FLAGS, environment) as browser:
        yield browser


@contextmanager
def fixed_page(browser: Browser, folder: Path) -> Iterator[Page]:
    """A page where time stands still and nothing moves; it shows `folder` as /data."""
    context = browser.new_context(reduced_motion="reduce", locale="en-GB", timezone_id="UTC")
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.clock.set_fixed_time(NOW)
    page.add_init_script(_RENAME % {"old": json.dumps(str(folder)), "new": json.dumps("/data")})
    try:
        yield page
    finally:
        context.close()


def wait_until_quiet(page: Page, milliseconds: float = 400) -> None:
    """Waits until all pictures are loaded and nothing has changed for so long, but not for ever."""
    page.evaluate(_QUIET, [milliseconds, _MOST_MS])


def screenshot(page: Page, *, whole: bool = True) -> Picture:
    """The whole page, or what the window shows of it. Playwright's own takes twice as long to encode it."""
    options: dict[str, Any] = {"format": "png", "optimizeForSpeed": True}
    if whole:
        width, height = page.evaluate(
            "[document.documentElement.clientWidth, document.documentElement.scrollHeight]"
        )
        options |= {"captureBeyondViewport": True}
        options |= {"clip": {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}}
    session = page.context.new_cdp_session(page)
    data = base64.b64decode(session.send("Page.captureScreenshot", options)["data"])
    session.detach()
    return expand(data)
