"""A real browser for tests: Debian's Chromium, driven by Playwright."""

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

PHONE, DESK = 390, 1440  # pixels
expect.set_options(timeout=30_000)  # ms: Playwright's 5 s are too few on a loaded machine
# What a browser reports of itself, whatever the page does: a screenshot has to wait for a software GPU.
_NOISE = re.compile("GPU stall due to ReadPixels")

# What a finger would miss: under 24 pixels in a direction (WCAG 2.5.8).
SMALL = """() => [...document.querySelectorAll("a, button, input, select, summary")].filter((node) => {
  const {width, height} = node.getBoundingClientRect(), small = Math.min(width, height) < 24;
  return small && node.checkVisibility({visibilityProperty: true}) && !node.closest(".skip");
}).map((node) => node.outerHTML.slice(0, 80))"""
KEYBOARD = Path(__file__).with_name("keyboard.js").read_text()


@contextmanager
def chromium(
    flags: Sequence[str] = (), environment: dict[str, str | float | bool] | None = None
) -> Iterator[Browser]:
    """The browser of the machine while the context lasts; skips the test where there is none."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no chromium here")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", *flags], env=environment
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
    theme: Literal["light", "dark"] = "light",
    tolerate: Callable[[str], bool] = lambda _: False,
) -> Iterator[Page]:
    """A page in a window of its own. At the end nothing may have gone wrong but what is tolerated."""
    size: Any = {"width": width, "height": 844 if width == PHONE else 900}
    context = browser.new_context(viewport=size, color_scheme=theme, has_touch=width == PHONE)
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
