"""Delivery to one target: tries again, gives up, goes on after a kill, and holds nothing up."""

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from panolog.orchestrator.watch.follower.board import Board, News
from panolog.orchestrator.watch.follower.couriers import Courier
from panolog.orchestrator.watch.follower.ledger import Ledger
from panolog.orchestrator.watch.follower.notifications import Kind, Notification
from panolog.orchestrator.watch.follower.sending import Refusal
from panolog.orchestrator.watch.follower.targets import Target
from panolog.scene.files import write_bytes
from tests.orchestrator.fakes import SetClock

TARGET = Target("webhook", "label", "http://127.0.0.1:1/")
LATER, NEVER = Refusal("HTTP 503", final=False), Refusal("HTTP 404", final=True)
WHOLE_RUN = 1e6  # seconds: more than all tries take


def notice(record: int, kind: Kind = Kind.PREEMPTED) -> Notification:
    return Notification(f"r-{kind}-{record}", kind, 1.0, "place", "text", {}, record)


class Post:
    """Takes notifications; answers each in turn as the test wants, then takes all."""

    def __init__(self, answers: Sequence[Refusal | None] = ()) -> None:
        self.answers, self.tried = list(answers), list[str]()
        self.taken: list[str] = []
        self.begun = threading.Event()  # once something was tried

    def __call__(self, _: Target, notification: Notification) -> Refusal | None:
        self.tried.append(notification.id)
        answer = self.answers.pop(0) if self.answers else None
        if answer is None:
            self.taken.append(notification.id)
        self.begun.set()
        return answer


def deliver(
    path: Path, post: Post, *notices: Notification, run: str = "run", began: int = 0, left: float = WHOLE_RUN
) -> Courier:
    """One courier of a run that has ended, in this thread. Args: left, seconds on a clock of its own."""
    board = Board(SetClock())
    board.publish(News(run, began, notices, ended=True), left)
    courier = Courier(TARGET, board, path / "ledger.json", post)
    courier.run()
    return courier


def test_what_is_refused_for_now_is_tried_again_in_order(tmp_path: Path) -> None:
    post = Post([LATER, LATER])
    courier = deliver(tmp_path, post, notice(1), notice(2))
    assert post.tried == ["r-preempted-1"] * 3 + ["r-preempted-2"]
    assert courier.problem == ""


def test_what_is_refused_for_good_is_given_up_and_said(tmp_path: Path) -> None:
    post = Post([NEVER])
    courier = deliver(tmp_path, post, notice(1), notice(2, Kind.DONE))
    assert post.taken == ["r-done-2"]
    assert courier.problem == "HTTP 404; not delivered: preempted"
    again = Post()
    deliver(tmp_path, again, notice(1), notice(2, Kind.DONE))
    assert again.tried == []


def test_news_of_a_live_run_are_sent_at_once_and_its_end_ends_a_pause(tmp_path: Path) -> None:
    """A target that wants an hour's rest is tried again at once: little time is left."""
    board, post = Board(), Post([replace(LATER, after=3600.0)])
    board.publish(News("run", 0, (notice(1),)))
    courier = Courier(TARGET, board, tmp_path / "ledger.json", post)
    courier.start()
    assert post.begun.wait(120)
    board.publish(News("run", 0, (notice(1),), ended=True), WHOLE_RUN)
    courier.join(120)
    assert not courier.is_alive()
    assert courier.problem == ""
    assert Ledger(tmp_path / "ledger.json", "run").get("delivered", []) == ["r-preempted-1"]


def test_tries_are_bounded(tmp_path: Path) -> None:
    post = Post([LATER] * 1_000)
    deliver(tmp_path, post, notice(1))
    assert len(post.tried) == 60


def test_the_time_after_the_end_is_bounded_and_the_next_follower_goes_on(tmp_path: Path) -> None:
    post = Post([LATER] * 1_000)
    courier = deliver(tmp_path, post, notice(1), left=30.0)
    assert len(post.tried) == 7  # after 0, 2, 6, 11, 16, 21 and 26 seconds
    assert "HTTP 503" in courier.problem
    post = Post()
    deliver(tmp_path, post, notice(1), notice(2))
    assert post.taken == ["r-preempted-1", "r-preempted-2"]
    post = Post()
    deliver(tmp_path, post, notice(1), notice(2), notice(3))
    assert post.tried == ["r-preempted-3"]  # what was delivered is not sent again


def test_a_kill_between_sending_and_noting_sends_the_same_id_again(tmp_path: Path) -> None:
    class Killed(Ledger):
        def keep(self, **values: object) -> None:
            if "delivered" not in values:
                super().keep(**values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("panolog.orchestrator.watch.follower.couriers.Ledger", Killed)
        deliver(tmp_path, first := Post(), notice(1))
    deliver(tmp_path, second := Post(), notice(1))
    assert first.taken == second.taken == ["r-preempted-1"]


def test_what_was_before_is_no_news_to_a_new_target(tmp_path: Path) -> None:
    post = Post()
    deliver(tmp_path, post, notice(1), notice(5), began=3)
    assert post.taken == ["r-preempted-5"]


def test_of_many_notifications_the_end_still_arrives(tmp_path: Path) -> None:
    post = Post()
    deliver(tmp_path, post, *(notice(number) for number in range(1, 301)), notice(999, Kind.FAILED))
    assert len(post.taken) == 101
    assert post.taken[-1] == "r-failed-999"


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"[]", b'{"run": "run", "delivered": 3, "since": "x"}', b"[" * 9999),
        b'{"run": "other", "delivered": ["r-preempted-1"]}',
    ],
)
def test_a_ledger_that_is_damaged_or_of_another_run_counts_as_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "ledger.json").write_bytes(content)
    deliver(tmp_path, post := Post(), notice(1))
    assert post.taken == ["r-preempted-1"]


def test_what_could_not_be_noted_on_a_full_disk_is_noted_with_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [None, OSError(28, "No space left on device")]

    def once(path: Path, data: bytes) -> None:
        if error := left.pop(0) if left else None:
            raise error
        write_bytes(path, data)

    monkeypatch.setattr("panolog.orchestrator.watch.follower.ledger.write_bytes", once)
    deliver(tmp_path, post := Post(), notice(1), notice(2))
    assert post.taken == ["r-preempted-1", "r-preempted-2"]
    deliver(tmp_path, post := Post(), notice(1), notice(2))
    assert post.tried == []
