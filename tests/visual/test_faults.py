"""Faults that were there once, put into a page on purpose: each is found, and what no eye can see is not."""

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Page

from tests.visual import legible
from tests.visual.browser import fixed_browser, fixed_page, screenshot, wait_until_quiet
from tests.visual.compare import Picture, compare, expand, reduce
from tests.visual.pages import SHOTS, WIDTHS, Site, site

pytestmark = pytest.mark.system

_STYLE = """(rules) => {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(rules);
  document.adoptedStyleSheets = [sheet];
}"""
# Name -> rules that put a fault into the page of a finished run, whose curves and map are drawn.
_SEEN = {
    "a slab over a chart": "#charts .plot .svg-container::after { content: ''; position: absolute;"
    " inset: 0 0 60% 0; background: rgb(68 68 68 / 30%); }",
    "a map of the wrong width": "#map-plot .svg-container { clip-path: inset(0 40% 0 0); }",
    "a curve is missing": "#charts .scatterlayer .trace:first-child { display: none; }",
    "a chart is missing": "#charts figure:nth-child(2) .plot { visibility: hidden; }",
    "a word in another colour": "#status { color: var(--failed); }",
    "a translucent smear": "#stage .compare { filter: blur(5px); opacity: 0.8; }",
    "text over text": "#events li > * { margin-left: -40px; }",
    "a row less": "#block-table tbody tr:nth-child(2) { visibility: hidden; }",
}
_UNSEEN = {
    "a pixel to the side": "#content { transform: translate(-1px, 1px); }",
    "a shade darker": "main { filter: brightness(0.992); }",
    "softer letters": "main { -webkit-text-stroke: 0.1px; }",
}


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("site")) as found:
        yield found


@pytest.fixture(scope="module")
def page(here: Site) -> Iterator[Page]:
    """A finished run at a desk."""
    (shot,) = (shot for shot in SHOTS if shot.name == "run-finished")
    with fixed_browser() as browser, fixed_page(browser, WIDTHS["desk"], here.root) as opened:
        shot.open(here, opened)
        shot.settle(opened, patience=2)
        yield opened


@pytest.fixture(scope="module")
def right(page: Page) -> Picture:
    """The page without a fault."""
    return styled(page, "")


def styled(page: Page, rules: str) -> Picture:
    page.evaluate(_STYLE, rules)
    wait_until_quiet(page, 100)
    return screenshot(page)


def look(right: Picture, shown: Picture) -> str:
    """How a screenshot differs from another one that was kept as a reference."""
    return compare(expand(reduce(right)), expand(reduce(shown))).reason


def test_the_fonts_are_those_of_matplotlib_on_every_machine(page: Page) -> None:
    session = page.context.new_cdp_session(page)
    session.send("DOM.enable")
    session.send("CSS.enable")
    root = session.send("DOM.getDocument")["root"]["nodeId"]
    for selector, family in (("h1", "DejaVu Sans"), ("#scene", "DejaVu Sans Mono")):
        node = session.send("DOM.querySelector", {"nodeId": root, "selector": selector})["nodeId"]
        fonts = session.send("CSS.getPlatformFontsForNode", {"nodeId": node})["fonts"]
        assert [font["familyName"] for font in fonts] == [family]


@pytest.mark.parametrize("fault", _SEEN)
def test_a_fault_that_can_be_seen_is_a_difference(page: Page, right: Picture, fault: str) -> None:
    assert look(right, styled(page, _SEEN[fault]))


@pytest.mark.parametrize("change", _UNSEEN)
def test_what_cannot_be_seen_is_none(page: Page, right: Picture, change: str) -> None:
    assert look(right, styled(page, _UNSEEN[change])) == ""


def test_a_page_of_another_size_is_a_difference(right: Picture) -> None:
    assert "wide" in look(right, right[:, :-2])
    assert "high" in look(right, right[:-6])
    assert look(right, right[:-2]) == ""


_HARD_TO_READ = {  # name -> rules, and a text that is then hard to read
    "text of a chart on a slab": (
        "#charts .plot .svg-container { background: #777; }",
        "10k",
    ),
    "text under a slab": (
        "#stages { position: relative; } #stages::after { content: ''; position: absolute; inset: 0;"
        " background: rgb(128 128 128 / 85%); }",
        "Stage I",
    ),
    "a placeholder": ("#log-text::placeholder { color: #aaa; }", "Search"),
    "a field": ("#view-source { color: #bbb; }", None),
    "a translucent part": ("#facts { opacity: 0.35; }", "Progress"),
    "text on a picture": (".tag { background: none !important; color: #fff; }", "render"),
}


@pytest.mark.parametrize("fault", _HARD_TO_READ)
def test_text_that_is_hard_to_read_is_found(page: Page, fault: str) -> None:
    rules, text = _HARD_TO_READ[fault]
    found = legible.low_contrast(page, styled(page, rules))
    assert any(text is None or f": {text!r}" in line for line in found), found


def test_what_makes_a_page_wide_is_found(page: Page) -> None:
    styled(page, "#map-plot { min-width: 1500px; }")
    assert any("map-plot" in line for line in legible.sideways(page))


def test_text_over_text_is_found(page: Page) -> None:
    styled(page, "#facts dd { margin-top: -18px; }")
    assert any("Progress" in line for line in legible.overlapping(page))


def test_the_page_itself_has_none_of_that(page: Page) -> None:
    shown = styled(page, "")
    assert legible.low_contrast(page, shown) == legible.overlapping(page) == legible.sideways(page) == []
    assert np.mean(shown) > 100  # it is light
