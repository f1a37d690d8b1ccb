"""The queue on the page of all runs: what the API says of it and accepts, and the panel in a real browser."""

import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.database import DATABASE, Queue
from panolog.orchestrator.runs.queue.entries import Command, Needs, Share, State
from panolog.orchestrator.runs.queue.runner import lock_of
from panolog.orchestrator.watch.dashboard.messages import QueueList
from tests.orchestrator.watch.dashboard.browser import PHONE, SMALL, opened
from tests.orchestrator.watch.dashboard.served import EVIL, POST, Served, serving, streaming, write_run


@contextmanager
def queued(root: Path, names: Sequence[str]) -> Iterator[tuple[Served, Queue]]:
    """A server with a queue whose first run is at work, under a runner."""
    root = root.resolve()
    write_run(root / "runs" / names[0])
    with closing(Queue(root / "queue")) as queue:
        for number, name in enumerate(names):
            run = root / "runs" / name
            needs = Needs(gpus=2 if number == 2 else None)
            queue.add(Command(run, ("/scene", "--output", str(run)), (), root, needs))
        queue.claim(1)
        share = Share(("GPU-a",), (0, 1), 3 * 2**30)
        queue.launched(1, processes.identity(os.getpid()), share)
        with lock.hold(lock_of(queue.folder)), serving(root / "runs", queue=queue.folder) as served:
            yield served, queue


def act(served: Served, action: str, entry: Any, before: Any = None) -> httpx.Response:
    body = json.dumps({"action": action, "entry": entry, "before": before})
    return served.client.post("/api/queue", content=body, headers=POST)


def order(queue: Queue) -> list[int]:
    return [entry.id for entry in queue.entries()]


def test_the_list_has_the_queue_and_follows_it(tmp_path: Path) -> None:
    with queued(tmp_path, ("a", "b", "c")) as (served, queue), streaming(served) as messages:
        shown = QueueList.model_validate(next(messages)[1]["queue"])
        assert (shown.runner, shown.folder, shown.error) == (True, str(queue.folder), None)
        assert [(row.id, row.name, row.state, row.run is not None) for row in shown.entries] == [
            (1, "a", "running", True),
            (2, "b", "waiting", False),
            (3, "c", "waiting", False),
        ]
        assert shown.entries[0].run == served.id("a")
        assert [row.share for row in shown.entries] == ["1 GPU, 2 cores, 3.0 GiB", "", "2 GPUs"]
        queue.end(1, State.FAILED, 1, "out of memory")
        row = next(messages)[1]["queue"]["entries"][-1]
        assert (row["id"], row["state"], row["reason"]) == (1, "failed", "out of memory")


def test_actions_change_the_queue_or_say_why_not(tmp_path: Path) -> None:
    with queued(tmp_path, ("a", "b", "c")) as (served, queue):
        assert act(served, "move", 3, 2).status_code == 202
        assert order(queue) == [1, 3, 2]
        assert act(served, "move", 3).status_code == 202
        assert order(queue) == [1, 2, 3]
        refused = act(served, "remove", 1)
        assert refused.status_code == 409
        assert refused.json()["error"].startswith("entry 1 is running; stop it first: `panolog stop ")
        assert act(served, "remove", 2).status_code == 202
        assert order(queue) == [1, 3]
        assert act(served, "retry", 3).status_code == 409
        assert act(served, "move", 99, 3).json()["error"].startswith("the queue has no entry 99")


def test_bad_requests_are_refused(tmp_path: Path) -> None:
    wrong: list[tuple[str, Any, Any]] = [("add", 1, None), ("move", "2", None), ("move", 0, None)]
    wrong += [("move", 2, -1), ("move", 2**63, None), ("move", None, 1)]
    with queued(tmp_path, ("a", "b")) as (served, queue):
        for action, entry, before in wrong:
            assert act(served, action, entry, before).status_code == 422, (action, entry, before)
        assert order(queue) == [1, 2]


def test_without_a_queue_there_is_no_panel_and_a_damaged_one_says_so(tmp_path: Path) -> None:
    write_run(tmp_path / "runs" / "a")
    for queue in (None, tmp_path / "queue"):
        with serving(tmp_path / "runs", queue=queue) as served:
            assert served.get("/api/runs")["queue"] is None
            assert act(served, "remove", 1).json()["error"] == "there is no queue"
    assert not (tmp_path / "queue").exists()  # looking makes none
    (tmp_path / "queue").mkdir()
    (tmp_path / "queue" / DATABASE).write_bytes(b"no database, but longer than the header of one: " * 9)
    with serving(tmp_path / "runs", queue=tmp_path / "queue") as served:
        assert "file is not a database" in served.get("/api/runs")["queue"]["error"]
        assert act(served, "remove", 1).status_code == 409


@pytest.mark.system
def test_entries_are_moved_and_removed_by_keyboard(browser: Browser, tmp_path: Path) -> None:
    with (
        queued(tmp_path, ("a", "b", "c", "d")) as (served, queue),
        opened(browser, served.url, tolerate=lambda text: "409" in text) as page,
    ):
        expect(page.locator("#queue-entries li")).to_have_count(4)
        expect(page.locator("#queue-runner")).to_have_text("A runner is at work")
        page.get_by_role("button", name="Move d up").focus()
        page.keyboard.press("Enter")
        expect(page.locator("#queue-entries .run-name").nth(2)).to_have_text("d")
        expect(page.get_by_role("button", name="Move d up")).to_be_focused()  # it can be pressed again
        page.keyboard.press("Enter")
        expect(page.locator("#queue-entries .run-name").nth(1)).to_have_text("d")
        assert order(queue) == [1, 4, 2, 3]
        expect(page.get_by_role("button", name="Move d up")).to_have_attribute("aria-disabled", "true")
        expect(page.locator("#queue-said")).to_have_text("d is moved up")
        page.get_by_role("button", name="Move d down").click()
        expect(page.locator("#queue-entries .run-name").nth(1)).to_have_text("b")
        page.get_by_role("button", name="Remove b").click()
        page.locator("#confirm").get_by_role("button", name="Cancel").click()
        assert order(queue) == [1, 2, 4, 3]
        page.get_by_role("button", name="Remove b").click()
        page.locator("#confirm-yes").click()
        expect(page.locator("#queue-entries li")).to_have_count(3)
        assert order(queue) == [1, 4, 3]
        queue.end(1, State.STOPPED, 130, "stopped by a user")
        page.get_by_role("button", name="Retry a").click()
        expect(page.get_by_role("button", name="Retry a")).to_have_count(0)
        expect(page.locator("#queue-entries .run-name").nth(2)).to_have_text("a")
        assert queue.entry(1).state == State.WAITING
        page.get_by_role("button", name="Remove d").click()
        queue.claim(4)  # it starts meanwhile
        page.locator("#confirm-yes").click()
        expect(page.locator("#confirm-error")).to_contain_text("entry 4 is running; stop it first")
        assert order(queue) == [4, 3, 1]


def drag(page: Page, name: str, onto: str, *, above: bool, release: bool = True) -> None:
    """Drags the handle of an entry to the upper or lower half of another one."""
    rows = page.locator("#queue-entries li")
    box = rows.filter(has_text=name).locator(".queue-place").bounding_box()
    other = rows.filter(has_text=onto).bounding_box()
    assert box is not None and other is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + 30, other["y"] + other["height"] * (0.25 if above else 0.75), steps=4)
    if release:
        page.mouse.up()


@pytest.mark.system
def test_entries_are_dragged(browser: Browser, tmp_path: Path) -> None:
    names = ("one", "two", "three", "four")
    with queued(tmp_path, names) as (served, queue), opened(browser, served.url) as page:
        rows = page.locator("#queue-entries .run-name")
        expect(rows).to_have_count(4)
        drag(page, "four", "two", above=True)
        expect(rows.nth(1)).to_have_text("four")
        assert order(queue) == [1, 4, 2, 3]
        expect(page.locator("#queue-said")).to_have_text("four is moved to place 1")
        drag(page, "four", "three", above=False)
        expect(rows.nth(3)).to_have_text("four")
        drag(page, "two", "one", above=True)  # before what runs: it stays the first that waits
        drag(page, "four", "three", above=True, release=False)
        expect(page.locator("li.drop-above")).to_have_text(re.compile("three"))
        page.keyboard.press("Escape")
        page.mouse.up()
        expect(page.locator(".dragged, .drop-above, .drop-below")).to_have_count(0)
        drag(page, "one", "four", above=False)  # it is running
        assert order(queue) == [1, 2, 3, 4]
        expect(page.locator("#queue-error")).to_be_hidden()


@pytest.mark.system
def test_entries_are_dragged_by_a_finger_and_names_are_text(browser: Browser, tmp_path: Path) -> None:
    with (
        queued(tmp_path, ("one", "two", "three", evil := EVIL.replace("/", "_"))) as (served, queue),
        opened(browser, served.url, width=PHONE) as page,
    ):
        rows = page.locator("#queue-entries li")
        expect(rows).to_have_count(4)
        expect(rows.nth(3).locator(".run-name")).to_have_text(evil)
        assert page.evaluate(SMALL) == []
        handle, goal = rows.nth(2).locator(".queue-place").bounding_box(), rows.nth(1).bounding_box()
        assert handle is not None and goal is not None
        touch = page.context.new_cdp_session(page)
        x, y = handle["x"] + 8, handle["y"] + handle["height"] / 2
        for kind, height in (("Start", y), ("Move", y - 9), ("Move", goal["y"] + 3)):
            touch.send(
                "Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": [{"x": x, "y": height}]}
            )
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        expect(page.locator("#queue-entries .run-name").nth(1)).to_have_text("three")
        assert order(queue) == [1, 3, 2, 4]
