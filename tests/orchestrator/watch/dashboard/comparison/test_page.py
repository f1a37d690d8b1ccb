"""The page that compares runs, in a real browser: phone and desk, with the keyboard, while runs train."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.records import Record, ViewEvaluated
from panolog.orchestrator.watch.views.comparison.page import write_comparison
from panolog.workers.tasks import COARSE, EVAL
from tests.orchestrator.history import BEGAN, append, started
from tests.orchestrator.watch.dashboard.browser import PHONE, SMALL, opened, unreachable
from tests.orchestrator.watch.dashboard.served import EVIL, Served, serving
from tests.orchestrator.watch.views.comparison.runs import VALUES, metrics, progressed, write, write_picture
from tests.ray_head import wait_until
from tests.visual.compare import expand

pytestmark = pytest.mark.system

NAMES = ("first", "second", "<img src=x onerror=alert(1)>")
LEVELS = {"first": (20, 230), "second": (120, 230), NAMES[2]: (180, 230)}  # grey of renders and photographs


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs with pictures, the last one with hostile names."""
    root = tmp_path_factory.mktemp("folder")
    for number, name in enumerate(NAMES):
        values = {view: value + number for view, value in VALUES.items()}
        if number == 2:
            values[EVIL] = 20.0
        folder = write(root / name, measured=metrics(values), seed=number)
        for view in VALUES:
            write_picture(folder, view, *LEVELS[name])
            append(folder, ViewEvaluated(EVAL, view, {}))
    return root


@pytest.fixture(scope="module")
def served(root: Path) -> Iterator[Served]:
    with serving(root) as server:
        yield server


def url_of(served: Served, *names: str) -> str:
    return f"{served.url}/compare?" + "&".join(f"run={served.id(name)}" for name in names)


def settled(page: Page, runs: int) -> None:
    expect(page.locator("#facts thead th")).to_have_count(runs)
    expect(page.locator("#charts .scatterlayer .trace").first).to_be_attached()


def grey(box: Locator) -> tuple[int, int]:
    """The grey of the left and of the right part of a picture, below the knob and the names."""
    picture = expand(box.screenshot())
    row = picture[len(picture) * 3 // 4, :, 1]
    return int(row[len(row) // 4]), int(row[-len(row) // 4])


def shows(box: Locator, *wanted: int) -> None:
    """Waits until the left and the right part of a picture have these greys: it is loaded after a choice."""
    wait_until(lambda: max(map(abs, np.subtract(grey(box), wanted))) < 12, f"the greys {wanted}")


def test_runs_are_chosen_in_the_list_with_the_keyboard(browser: Browser, served: Served) -> None:
    with opened(browser, served.url) as page:
        compare = page.locator("#compare")
        expect(compare).to_have_attribute("aria-disabled", "true")
        page.get_by_label("Compare first", exact=True).focus()
        page.keyboard.press("Space")
        expect(compare).to_have_text("Compare 1 with …")
        page.keyboard.press("Enter")  # in a checkbox: nothing
        compare.focus()
        page.keyboard.press("Enter")
        expect(page).to_have_url(re.compile("/$"))  # one run is not enough
        page.get_by_label("Compare second", exact=True).focus()
        page.keyboard.press("Space")
        expect(compare).to_have_text("Compare 2")
        compare.focus()
        page.keyboard.press("Enter")
        settled(page, 2)
        assert page.locator("#facts thead th").all_inner_texts() == ["first", "second"]
        assert page.title() == "first | second · PanoLOG"


def test_differences_and_curves_of_chosen_runs(browser: Browser, served: Served) -> None:
    with opened(browser, url_of(served, "first", "second")) as page:
        settled(page, 2)
        row = page.locator("#metrics tbody tr").first
        expect(row.locator("td").nth(1)).to_contain_text("25.00+1.00better in 3, worse in 0 of 3")
        expect(row.locator(".difference")).to_have_class("difference good")
        expect(page.locator("#warnings")).to_be_hidden()
        traces = page.locator(".chart").first.locator(".scatterlayer .trace")
        expect(traces).to_have_count(2)
        page.locator("#shown").get_by_role("button", name="second").click()
        expect(traces).to_have_count(1)
        page.get_by_role("button", name="Minutes").click()
        expect(page.locator(".chart").first.locator(".xtitle")).to_have_text("minutes")


def test_any_two_runs_and_the_ground_truth_are_compared_and_runs_are_left_out(
    browser: Browser, served: Served
) -> None:
    with opened(browser, url_of(served, *NAMES)) as page:
        settled(page, 3)
        box = page.locator(".compare")
        box.scroll_into_view_if_needed()
        expect(page.locator(".tag")).to_have_text(["first", "second"])
        shows(box, 20, 120)
        page.get_by_label("Left").select_option(label=NAMES[2])
        shows(box, 180, 120)
        page.get_by_label("Right").select_option(label="ground truth")
        expect(page.locator(".tag")).to_have_text([NAMES[2], "ground truth"])
        shows(box, 180, 230)
        page.get_by_label("Left").select_option(label="ground truth")
        page.get_by_label("Right").select_option(label="first")
        shows(box, 230, 20)
        page.get_by_role("button", name="360°").click()
        expect(box.locator("canvas")).to_have_attribute("data-angles", "0.000 0.000 0.800")
        shows(box, 230, 20)
        page.get_by_role("button", name="c.jpg").click()
        expect(page.locator("#picture-caption")).to_contain_text("c.jpg · first: WS-PSNR 28.00")
        page.locator("#metric").select_option(label="LPIPS")
        expect(page.locator("#views tbody tr").filter(has_text="c.jpg")).to_contain_text("0.4400")
        page.get_by_role("link", name="Compare the others with second").click()
        heads = page.locator("#facts thead th")
        expect(heads).to_have_text(["second", "first", NAMES[2]])
        expect(page.locator("#metrics-note")).to_contain_text("compared with second")
        page.get_by_role("link", name="Leave first out").click()
        expect(heads).to_have_text(["second", NAMES[2]])
        link = page.locator("#chosen").get_by_role("link", name="second", exact=True)
        expect(link).to_have_attribute("href", f"/runs/{served.id('second')}")


def test_the_page_follows_runs_that_train(browser: Browser, tmp_path: Path) -> None:
    write(tmp_path / "done", measured=metrics())
    begun: list[tuple[float, Record]] = [
        (0.0, BEGAN),
        (0.0, started(COARSE)),
        (1.0, progressed(COARSE, 10, 90)),
    ]
    live = write(tmp_path / "live", records=begun)
    with (
        lock.hold(live.lock),
        serving(tmp_path) as server,
        opened(browser, url_of(server, "done", "live")) as page,
    ):
        settled(page, 2)
        expect(page.locator("#warning-list")).to_contain_text("not finished: live (running")
        facts = page.locator("#facts tbody")
        expect(facts).to_contain_text("10 of 100")
        append(live, progressed(COARSE, 60, 91))
        expect(facts).to_contain_text("60 of 100")
        expect(page.locator(".chart").first.locator(".scatterlayer .trace")).to_have_count(2)


def test_a_run_that_is_gone_or_damaged_is_said(browser: Browser, served: Served, tmp_path: Path) -> None:
    write(tmp_path / "a")
    write(tmp_path / "b").info.write_text("{")
    with serving(tmp_path) as server, opened(browser, f"{url_of(server, 'a', 'b')}&run={'0' * 16}") as page:
        settled(page, 3)
        expect(page.locator("#facts .pill")).to_have_text(["done", "unreadable", "unreadable"])
        expect(page.locator("#facts .error")).to_have_count(2)
    refused = re.compile("the server responded with a status of 422")
    with opened(browser, f"{served.url}/compare", tolerate=refused.search) as page:
        for query in (f"?run={served.id('first')}", "?run=nonsense&run=other"):
            expect(page.locator("#missing")).to_contain_text("Choose two to eight runs")
            page.goto(f"{served.url}/compare{query}")
        expect(page.locator("#missing")).to_contain_text("Choose two to eight runs")


def test_all_can_be_reached_and_names_stay_text(
    browser: Browser, served: Served, root: Path, tmp_path: Path
) -> None:
    def frozen(_: object) -> None:
        raise AssertionError("a script of a run has run")

    report = tmp_path / "report.html"
    write_comparison([root / name for name in NAMES], report)
    for url in (url_of(served, *NAMES), report.as_uri()):
        with opened(browser, url, width=PHONE) as page:
            page.on("dialog", frozen)
            settled(page, 3)
            expect(page.locator("#facts thead th").last).to_have_text(NAMES[2])
            expect(page.locator("#views")).to_contain_text(EVIL)
            expect(page.locator("#warning-list")).to_contain_text(NAMES[2])
            assert page.evaluate("document.querySelectorAll('#content script, img:not([alt])').length") == 0
            assert page.evaluate(SMALL) == []
            assert url != report.as_uri() or unreachable(page) == []  # of both the same
