"""What each page shows, in each state of a run, at both widths and in both themes."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from tests.visual import legible, references
from tests.visual.browser import fixed_browser, fixed_page, screenshot
from tests.visual.pages import SHOTS, THEMES, WIDTHS, Shot, Site, site

pytestmark = pytest.mark.system
_PATIENCE = (1, 3, 5)  # how much longer each time a page may take on a busy machine


@dataclass(frozen=True)
class Window:
    """A window of one width."""

    size: str
    page: Page


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("site")) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with fixed_browser() as running:
        yield running


@pytest.fixture(scope="module", params=WIDTHS)
def window(browser: Browser, here: Site, request: pytest.FixtureRequest) -> Iterator[Window]:
    with fixed_page(browser, WIDTHS[request.param], here.root) as page:
        yield Window(request.param, page)


@pytest.mark.parametrize("shot", SHOTS, ids=lambda shot: shot.name)
def test_a_page_looks_right_and_can_be_read(window: Window, here: Site, shot: Shot, tmp_path: Path) -> None:
    page = window.page
    shot.open(here, page)
    wrong = {"sideways": legible.sideways(page), "over each other": legible.overlapping(page)}
    for theme in THEMES:
        shot.show(page, theme)
        name = f"{shot.name}-{window.size}-{theme}"
        for patience in _PATIENCE:
            shown = screenshot(page, whole=shot.whole)
            reason = references.difference(name, shown, tmp_path)
            faint = legible.low_contrast(page, shown, whole=shot.whole)
            if not reason and not faint:
                break
            shot.settle(page, patience=patience)
        wrong |= {name: [reason] if reason else [], f"contrast, {theme}": faint}
    assert {what: found for what, found in wrong.items() if found} == {}
