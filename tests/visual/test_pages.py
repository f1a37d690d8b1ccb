"""What each page shows, in each state of a run; and that faults which were there once would be found."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from tests.visual import legible, references
from tests.visual.browser import fixed_browser, fixed_page, screenshot, wait_until_quiet
from tests.visual.compare import TILE, Picture, compare, expand, reduce
from tests.visual.pages import SHOTS, Shot, Site, show, site

pytestmark = pytest.mark.system

_QUIET_MS = (
    400,
    1_200,
    2_000,
)  # without a change, after which a page is looked at, and again on a busy machine
_STYLE = """(rules) => {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(rules);
  document.adoptedStyleSheets = [sheet];
}"""
# Faults that can be seen in the page of a finished run: what they are in, and rules that make them there.
_SEEN = {
    "a slab over a chart": (
        "#charts figure:nth-child(1)",
        "#charts figure:nth-child(1) .svg-container::after { content: ''; position: absolute;"
        " inset: 0 0 60% 0; background: rgb(68 68 68 / 30%); }",
    ),
    "a chart is missing": (
        "#charts figure:nth-child(2)",
        "#charts figure:nth-child(2) .plot { visibility: hidden; }",
    ),
    "a curve is missing": (
        "#charts figure:nth-child(3)",
        "#charts figure:nth-child(3) .scatterlayer .trace:first-child { display: none; }",
    ),
    "a map of the wrong width": ("#map-plot", "#map-plot .svg-container { clip-path: inset(0 40% 0 0); }"),
    "a word in another colour": ("#status", "#status { color: var(--failed); }"),
    "a translucent smear": ("#stage", "#stage .compare { filter: blur(5px); opacity: 0.8; }"),
    "text over text": ("#events", "#events li > * { margin-left: -40px; }"),
    "a row less": ("#block-table tbody", "#block-table tbody tr:nth-child(2) { visibility: hidden; }"),
}
_UNSEEN = (  # a pixel to the side, a shade darker, softer letters
    "#content { transform: translate(-1px, 1px); }"
    " main { filter: brightness(0.992); -webkit-text-stroke: 0.1px; }"
)
_HARD_TO_READ = {  # rules, and a text that is then hard to read
    "#charts figure:first-child .plot .svg-container { background: #777; }": "10k",  # on a slab
    "#stages { position: relative; } #stages::after { content: ''; position: absolute; inset: 0;"
    " background: rgb(128 128 128 / 85%); }": "Stage I",  # under a slab
    "#log-text::placeholder { color: #aaa; }": "Search",
    "#view-source { color: #bbb; }": "held_out_000.jpg",  # in a field
    "#facts { opacity: 0.35; }": "Progress",
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
    for view in shot.views:
        show(page, view)
        for quiet in _QUIET_MS:
            wait_until_quiet(page, quiet)
            shown = screenshot(page, whole=shot.whole)
            wrong[view] = [
                *filter(None, [references.difference(f"{shot.name}-{view}", shown, tmp_path)]),
                *legible.low_contrast(page, shown, whole=shot.whole),
                *legible.sideways(page),
                *legible.overlapping(page),
            ]
            if not wrong[view]:
                break
    assert {view: found for view, found in wrong.items() if found} == {}


@pytest.fixture(scope="module")
def finished(browser: Browser, here: Site) -> Iterator[Page]:
    """A finished run at a desk, for tests that give it rules of their own."""
    (shot,) = (shot for shot in SHOTS if shot.name == "run-finished")
    with fixed_page(browser, here.root) as opened:
        shot.open(here, opened)
        wait_until_quiet(opened, 1_000)
        yield opened


@pytest.fixture(scope="module")
def right(finished: Page) -> Picture:
    """The page without a fault, as a reference is kept."""
    return styled(finished, "")


def styled(page: Page, rules: str) -> Picture:
    """A picture of a page with more rules, as a reference is kept."""
    page.evaluate(_STYLE, rules)
    wait_until_quiet(page)
    return expand(reduce(screenshot(page)))


def test_the_fonts_are_those_of_matplotlib_on_every_machine(finished: Page) -> None:
    session = finished.context.new_cdp_session(finished)
    session.send("DOM.enable")
    session.send("CSS.enable")
    root = session.send("DOM.getDocument")["root"]["nodeId"]
    for selector, family in (("h1", "DejaVu Sans"), ("#scene", "DejaVu Sans Mono")):
        node = session.send("DOM.querySelector", {"nodeId": root, "selector": selector})["nodeId"]
        fonts = session.send("CSS.getPlatformFontsForNode", {"nodeId": node})["fonts"]
        assert [font["familyName"] for font in fonts] == [family]


def test_each_fault_that_can_be_seen_is_a_difference(finished: Page, right: Picture) -> None:
    comparison = compare(right, styled(finished, " ".join(rules for _, rules in _SEEN.values())))
    unnoticed = []
    for fault, (place, _) in _SEEN.items():
        box = finished.locator(place).bounding_box()
        assert box is not None
        left, top = int(box["x"] / 2 / TILE), int(box["y"] / 2 / TILE)
        right_of, below = (box["x"] + box["width"]) / 2 / TILE + 1, (box["y"] + box["height"]) / 2 / TILE + 1
        if not comparison.tiles[top : int(below), left : int(right_of)].any():
            unnoticed.append(fault)
    assert unnoticed == []


def test_what_cannot_be_seen_is_none(finished: Page, right: Picture) -> None:
    assert compare(right, styled(finished, _UNSEEN)).reason == ""


def test_a_page_of_another_size_is_a_difference(right: Picture) -> None:
    assert "wide" in compare(right, right[:, :-1]).reason
    assert "high" in compare(right, right[:-3]).reason
    assert compare(right, right[:-1]).reason == ""


def test_text_that_is_hard_to_read_or_out_of_place_is_found(finished: Page) -> None:
    finished.evaluate(_STYLE, " ".join(_HARD_TO_READ))
    found = legible.low_contrast(finished)
    assert [text for text in _HARD_TO_READ.values() if not any(f": {text!r}" in line for line in found)] == []
    finished.evaluate(_STYLE, "#map-plot { min-width: 1500px; } #facts dd { margin-top: -18px; }")
    assert any("map-plot" in line for line in legible.sideways(finished))
    assert any("Progress" in line for line in legible.overlapping(finished))
