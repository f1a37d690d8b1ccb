"""What each page shows, in each state of a run, and that axe finds no fault with it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_folder
from tests.export.peers import peer
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.views.sites import ready, run_with, serving
from tests.visual import legible
from tests.visual.browser import fixed_browser, fixed_page, screenshot, wait_until_quiet
from tests.visual.compare import TILE, Picture, compare, difference, expand, reduce
from tests.visual.pages import SHOTS, WIDTHS, Shot, Site, show, site

pytestmark = pytest.mark.system

# Without a change, after which a page is looked at, and again on a busy machine.
_QUIET_MS = (400, 1_200, 2_000)
_STYLE = """(rules) => {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(rules);
  document.adoptedStyleSheets = [sheet];
}"""
# By what it is in, a fault of the page of a finished run that a reader would see.
_SEEN = {
    "#charts figure:nth-child(3)": "figure:nth-child(3) .scatterlayer .trace:first-child { display: none; }",
    "#map-plot": "#map-plot > svg { clip-path: inset(0 40% 0 0); }",
    "#status": "#status { color: var(--failed); }",
    "#events": "#events li > * { margin-left: -40px; }",
}
_UNSEEN = (  # a pixel to the side, a shade darker, softer letters
    "#content { transform: translate(-1px, 1px); }"
    " main { filter: brightness(0.992); -webkit-text-stroke: 0.1px; }"
)
_HARD_TO_READ = {  # rules, and a text that is then hard to read
    "#stages { position: relative; } #stages::after { content: ''; position: absolute; inset: 0;"
    " background: rgb(128 128 128 / 85%); }": "Stage I",  # under a slab
    "#view-source { color: #bbb; }": "held_out_000.jpg",  # in a field
    ".tag { background: none !important; color: #999; }": "render",  # on a picture
}


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("site")) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with fixed_browser() as running:
        yield running


@pytest.fixture(scope="module")
def page(browser: Browser, here: Site) -> Iterator[Page]:
    with fixed_page(browser, here.root) as opened:
        yield opened


@pytest.mark.parametrize("shot", SHOTS, ids=lambda shot: shot.name)
def test_a_page_looks_right_and_can_be_read(page: Page, here: Site, shot: Shot, tmp_path: Path) -> None:
    shot.open(here, page)
    wrong: dict[str, list[str]] = {}
    seen: set[str] = set()  # widths and themes: neither changes what the other decides
    for view in shot.views:
        new = {*view.split("-")} - seen
        seen |= new
        show(page, view)
        for quiet in _QUIET_MS:
            wait_until_quiet(page, quiet)
            shown = screenshot(page, whole=shot.whole)
            wrong[view] = [
                *filter(None, [difference(f"{shot.name}-{view}", shown, tmp_path)]),
                *(legible.low_contrast(page, shown, whole=shot.whole) if new & {"light", "dark"} else ()),
                *([*legible.sideways(page), *legible.overlapping(page)] if new & set(WIDTHS) else ()),
            ]
            if not wrong[view]:
                break
    assert {view: found for view, found in wrong.items() if found} == {}


@pytest.mark.nightly
def test_what_a_reader_would_see_is_found_and_no_more(browser: Browser, here: Site) -> None:
    (shot,) = (shot for shot in SHOTS if shot.name == "run-finished")
    with fixed_page(browser, here.root) as page:
        shot.open(here, page)
        wait_until_quiet(page, 1_000)
        right = styled(page, "")
        assert compare(right, styled(page, _UNSEEN)).reason == ""
        tiles = compare(right, styled(page, " ".join(_SEEN.values()))).tiles
        for place in _SEEN:
            box = page.locator(place).bounding_box()
            assert box is not None
            sides = (box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"])
            left, top, right_of, below = (int(side / 2 / TILE) for side in sides)
            assert tiles[top : below + 1, left : right_of + 1].any(), place
        page.evaluate(_STYLE, " ".join(_HARD_TO_READ))
        found = legible.low_contrast(page)
        assert all(any(f": {text!r}" in line for line in found) for text in _HARD_TO_READ.values())
        page.evaluate(_STYLE, "#map-plot { min-width: 1500px; } #facts dd { margin-top: -18px; }")
        assert any("map-plot" in line for line in legible.sideways(page))
        assert any("Progress" in line for line in legible.overlapping(page))


def styled(page: Page, rules: str) -> Picture:
    """A picture of a page with more rules, as a reference is kept."""
    page.evaluate(_STYLE, rules)
    wait_until_quiet(page)
    return expand(reduce(screenshot(page)))


_LOCK = Path(__file__).parent / "axe" / "package-lock.json"
_RUN = "axe.run(document, {resultTypes: ['violations']}).then(({violations}) => violations)"


def findings(page: Page) -> list[str]:
    """What axe finds: the rule, and the elements."""
    page.evaluate((peer("axe-core", _LOCK) / "axe.min.js").read_text() + "; undefined")
    found: list[dict[str, Any]] = page.evaluate(_RUN)
    return [f"{rule['id']}: {node['html'][:160]}" for rule in found for node in rule["nodes"][:3]]


@pytest.mark.nightly
@pytest.mark.parametrize("shot", SHOTS, ids=lambda shot: shot.name)
def test_axe_finds_nothing(here: Site, page: Page, shot: Shot) -> None:
    shot.open(here, page)
    wait_until_quiet(page, 400)
    assert findings(page) == []


@pytest.mark.nightly
def test_axe_finds_nothing_in_the_3d_page(browser: Browser, tmp_path: Path) -> None:
    write_folder(site_of_run(run_with(tmp_path), Wanted()), tmp_path / "web")
    with serving(tmp_path / "web") as url, opened(browser, url) as page:
        ready(page)
        page.click("#list")
        assert findings(page) == []
