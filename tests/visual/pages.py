"""The pages that have reference pictures: where each is, and what is chosen on it before it is looked at."""

import os
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Page, expect

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.queue.entries import Command, Needs, Share, State
from panolog.orchestrator.runs.queue.runner import lock_of
from panolog.orchestrator.watch.views.comparison.page import write_comparison
from panolog.orchestrator.watch.views.pages.report import write_report
from tests.orchestrator.watch.dashboard.browser import DESK, PHONE
from tests.orchestrator.watch.dashboard.served import Served, serving
from tests.visual.fixed import Clock, fixed_machine
from tests.visual.runs import NAMES, all_runs

WIDTHS = {"desk": DESK, "phone": PHONE}
_COMPARED = ("finished", "failed", "live")


@dataclass(frozen=True)
class Site:
    """The runs, reports of two, and the server of both."""

    root: Path
    served: Served
    runs: dict[str, RunFolder]
    reports: dict[str, Path]
    comparison: Path  # the report of several runs

    @property
    def compare_url(self) -> str:
        """The page that compares three runs."""
        ids = [self.served.id(self.runs[state].root.name) for state in _COMPARED]
        return f"{self.served.url}/compare?{'&'.join(f'run={id}' for id in ids)}"

    def run_url(self, state: str) -> str:
        """The page of a run."""
        return f"{self.served.url}/runs/{self.served.id(self.runs[state].root.name)}"


@dataclass(frozen=True)
class Shot:
    """One page in one state, and the widths and themes in which it is looked at.

    Colours do not depend on the width, and the layout does not depend on the theme.
    """

    name: str
    url: Callable[[Site], str]
    prepare: Callable[[Page], None] = lambda _: None  # after it has loaded
    views: tuple[str, ...] = ("desk-light", "desk-dark", "phone-light")
    whole: bool = True  # False: only what the window shows

    def open(self, site: Site, page: Page) -> None:
        """Shows the page as it is to be looked at, in its first view."""
        show(page, self.views[0])
        page.goto(self.url(site))
        self.prepare(page)
        page.mouse.move(0, 0)
        page.evaluate("scrollTo(0, 0); document.activeElement?.blur()")


def show(page: Page, view: str) -> None:
    """Gives a page the width and the theme of a view; one that is open requests nothing for that."""
    size, theme = view.split("-")
    page.set_viewport_size({"width": WIDTHS[size], "height": 844 if size == "phone" else 900})
    page.emulate_media(color_scheme="dark" if theme == "dark" else "light")


@contextmanager
def site(root: Path) -> Iterator[Site]:
    """All pages, on a machine and at a time that are fixed, while the context lasts."""
    root = root.resolve()
    with (
        fixed_machine() as clock,
        all_runs(root / "runs", clock) as runs,
        queue_at_work(root, root / "runs", clock) as queue,
        serving(root / "runs", queue=queue) as served,
    ):
        reports = {state: write_report(runs[state], root / f"{state}.html") for state in ("finished", "live")}
        comparison = root / "comparison.html"
        write_comparison([runs[state].root for state in _COMPARED], comparison)
        yield Site(root, served, runs, reports, comparison)


def _listed(page: Page) -> None:
    expect(page.locator("#runs tbody tr")).to_have_count(8)
    expect(page.locator("#queue-entries li")).to_have_count(5)


def _drawn(page: Page) -> None:
    """Waits for the parts of the page of a run that come last."""
    expect(page.locator("#map-plot .points")).to_be_attached()
    _charts(page)


def _prepared(page: Page) -> None:
    """Waits for the pictures of a preparation."""
    expect(page.locator("#prepared-pictures img")).to_have_count(2)
    for image in page.locator("#prepared-pictures img").all():
        image.scroll_into_view_if_needed()
        expect(image).to_have_js_property("complete", True)
    expect(page.locator("#map-plot .points")).to_be_attached()
    expect(page.locator("#events li").first).to_be_visible()


def _camera_around(page: Page) -> None:
    """A camera, and the 360° view of a picture."""
    _drawn(page)
    page.get_by_label("Camera", exact=True).fill("street_010.jpg")
    page.get_by_label("Camera", exact=True).press("Enter")
    expect(page.locator("#selected h3").first).to_have_text("street_010.jpg")
    page.get_by_role("button", name="360°").click()


def _failed_block(page: Page) -> None:
    _drawn(page)
    row = page.locator("#block-table tr[data-block]").filter(has_text="cannot be decoded")
    row.get_by_role("button").first.click()
    expect(page.locator("#selected")).to_contain_text("cannot be decoded")


def _charts(page: Page) -> None:
    """Waits for the curves of a run that has no blocks yet."""
    expect(page.locator("#charts .scatterlayer .trace").first).to_be_attached()
    expect(page.locator("#events li").first).to_be_visible()


def _confirm(page: Page) -> None:
    _drawn(page)
    page.locator("#actions").get_by_role("button", name="Stop").click()
    expect(page.locator("#confirm")).to_be_visible()


def _chosen(page: Page) -> None:
    """Two runs of the list are chosen to be compared."""
    _listed(page)
    for name in ("harbour", "old-town"):
        page.get_by_label(f"Compare {name}").check()


def _missing(page: Page) -> None:
    expect(page.locator("#missing")).to_be_visible()


def _compared(page: Page) -> None:
    """Waits for the curves of a comparison, and shows them by minutes."""
    expect(page.locator("#charts .scatterlayer .trace").first).to_be_attached()
    page.get_by_role("button", name="Minutes").click()


def _run(state: str, prepare: Callable[[Page], None], *views: str) -> Shot:
    return Shot(f"run-{state}", lambda site: site.run_url(state), prepare, views or Shot.views)


def _report(state: str, *views: str) -> Shot:
    return Shot(f"report-{state}", lambda site: site.reports[state].as_uri(), views=views or Shot.views)


SHOTS = (
    Shot("runs", lambda site: site.served.url, _chosen),
    Shot("compare", lambda site: site.compare_url, _compared),
    _run("finished", _camera_around),
    _run("live", _failed_block),
    _run("failed", _drawn, "desk-light", "phone-light"),
    _run("waiting", _drawn, "desk-dark", "phone-light"),
    _run("preparing", _prepared, "desk-light", "phone-light"),
    Shot("confirm", lambda site: site.run_url("live"), _confirm, ("desk-dark", "phone-light"), whole=False),
    Shot("missing", lambda site: f"{site.served.url}/runs/0123456789abcdef", _missing, ("phone-light",)),
    _report("finished"),
    _report("live", "desk-light"),
    Shot("comparison-report", lambda site: site.comparison.as_uri(), _compared, ("desk-light",)),
)


_FAILED = "depot: sparse/0/images.bin: names 12 panoramas that are not in images/; remove them from the model"


@contextmanager
def queue_at_work(root: Path, runs: Path, clock: Clock) -> Iterator[Path]:
    """The folder of a queue in which one run has failed, one is at work and three wait."""
    folder, now = root / "queue", clock.now
    with closing(Queue(folder)) as queue:
        clock.now = now - 9_000
        for name in ("depot", NAMES["live"], "canal", "north-gate", "station-2026-03-14-second-visit"):
            run = runs / name
            needs = Needs(gpus=4 if name == "canal" else None)
            queue.add(Command(run, (f"/data/scenes/{name}", "--output", str(run)), (), root, needs))
        queue.claim(1)
        clock.now = now - 8_400
        queue.end(1, State.FAILED, 2, _FAILED)
        queue.claim(2)
        share = Share(("GPU-5a", "GPU-5b"), tuple(range(16)), 56 * 2**30)
        queue.launched(2, processes.identity(os.getpid()), share)
        queue.note(3, "waits for 4 GPUs: 2 of 4 free")
    clock.now = now
    with lock.hold(lock_of(folder)):
        yield folder
