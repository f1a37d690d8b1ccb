"""A real browser for tests: Debian's Chromium, driven by Playwright.

Its headless shell draws the same pixels, and needs a quarter less time for what is around a page.
"""

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

PHONE, DESK = 390, 1440  # pixels
_PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
PATIENCE_MS = 120_000  # for what a machine under load does at last
expect.set_options(timeout=PATIENCE_MS)
# What a browser reports of itself, whatever the page does: a screenshot has to wait for a software GPU.
_NOISE = re.compile("GPU stall due to ReadPixels")
# What a page without its server reports.
AWAY = re.compile("ERR_(CONNECTION_REFUSED|CONNECTION_RESET|INCOMPLETE_CHUNKED|EMPTY_RESPONSE)")

# What a finger would miss: under 24 pixels in a direction (WCAG 2.5.8).
SMALL = """() => [...document.querySelectorAll("a, button, input, select, summary")].filter((node) => {
  const {width, height} = node.getBoundingClientRect(), small = Math.min(width, height) < 24;
  return small && node.checkVisibility({visibilityProperty: true}) && !node.closest(".skip");
}).map((node) => node.outerHTML.slice(0, 80))"""
# Where a camera of the map is on the screen.
PLACE = """(at) => {
  const discs = document.querySelectorAll("#map-plot .cameras"), box = discs[at].getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2];
}"""
KEYBOARD = Path(__file__).with_name("keyboard.js").read_text()


def program() -> str:
    """The browser of the machine; the test skips where there is none."""
    path = next(filter(None, map(shutil.which, _PROGRAMS)), None)
    if path is None:
        pytest.skip("no chromium here")
    return path


@contextmanager
def chromium(
    flags: Sequence[str] = (), environment: dict[str, str | float | bool] | None = None
) -> Iterator[Browser]:
    """The browser of the machine while the context lasts, as by `program`.

    Until it ends, asyncio.run is not possible in this thread.
    """
    path = program()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", *flags], env=environment, timeout=PATIENCE_MS
        )
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(
    browser: Browser,
    url: str,
    *,
    width: int = DESK,
    height: int = 900,
    tolerate: Callable[[str], object] = lambda _: False,
) -> Iterator[Page]:
    """A page in a window of its own. At the end nothing may have gone wrong but what is tolerated."""
    size: Any = {"width": width, "height": 844 if width == PHONE else height}
    context = browser.new_context(viewport=size, color_scheme="light", has_touch=width == PHONE)
    context.set_default_timeout(PATIENCE_MS)
    page, wrong = context.new_page(), []

    def record(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not _NOISE.search(message.text):
            wrong.append(f"{message.text} {message.location}")

    page.on("console", record)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    try:
        page.goto(url)
        yield page
        assert [text for text in wrong if not tolerate(text)] == []
    finally:
        context.close()


def unreachable(page: Page) -> list[str]:
    """What the Tab key does not reach, or reaches without showing it."""
    wanted, seen = set(page.evaluate(KEYBOARD)["reachable"]), {}
    for _ in range(2 * len(wanted)):
        page.keyboard.press("Tab")
        now = page.evaluate(KEYBOARD)
        seen[now["focused"]] = now["seen"]
    return [name for name in wanted if not seen.get(name)]
