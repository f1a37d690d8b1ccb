"""No page, in no state, has anything that axe finds fault with: names, roles, landmarks, contrast."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_folder
from tests.export.peers import peer
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.views.pictures import ready
from tests.orchestrator.watch.views.sites import run_with, serving
from tests.visual.browser import fixed_browser, fixed_page, wait_until_quiet
from tests.visual.pages import SHOTS, Shot, Site, site

pytestmark = [pytest.mark.system, pytest.mark.nightly]

_LOCK = Path(__file__).parent / "axe" / "package-lock.json"
_RUN = "axe.run(document, {resultTypes: ['violations']}).then(({violations}) => violations)"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with fixed_browser() as found:
        yield found


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("axe")) as found:
        yield found


@pytest.fixture(scope="module")
def page(browser: Browser, here: Site) -> Iterator[Page]:
    with fixed_page(browser, here.root) as found:
        yield found


def findings(page: Page) -> list[str]:
    """What axe finds: the rule, and the elements."""
    page.evaluate((peer("axe-core", _LOCK) / "axe.min.js").read_text() + "; undefined")
    found: list[dict[str, Any]] = page.evaluate(_RUN)
    return [f"{rule['id']}: {node['html'][:160]}" for rule in found for node in rule["nodes"][:3]]


@pytest.mark.parametrize("shot", SHOTS, ids=lambda shot: shot.name)
def test_axe_finds_nothing(here: Site, page: Page, shot: Shot) -> None:
    shot.open(here, page)
    wait_until_quiet(page, 400)
    assert findings(page) == []


def test_axe_finds_nothing_in_the_3d_page(browser: Browser, tmp_path: Path) -> None:
    write_folder(site_of_run(run_with(tmp_path), Wanted()), tmp_path / "web")
    with serving(tmp_path / "web") as url, opened(browser, url) as page:
        ready(page)
        page.click("#list")
        assert findings(page) == []
