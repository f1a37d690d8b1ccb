"""Which notifications follow from the records of a run, and how they are delivered to one target."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.machines.history import MACHINE_DIED
from panolog.orchestrator.runs.money.records import BudgetNear, BudgetReached
from panolog.orchestrator.runs.presence import Presence
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    EvaluationSaved,
    Failure,
    Leaving,
    NodeLeaving,
    NodeLeft,
    Outcome,
    PauseRequested,
    Progressed,
    Record,
    RunBegan,
    RunEnded,
    TaskFailed,
    TaskStarted,
    TaskYielded,
)
from panolog.orchestrator.watch.follower.board import ALL, Board, News
from panolog.orchestrator.watch.follower.couriers import Courier
from panolog.orchestrator.watch.follower.ledger import Ledger
from panolog.orchestrator.watch.follower.notifications import Kind, Notification
from panolog.orchestrator.watch.follower.sending import Refusal
from panolog.orchestrator.watch.follower.targets import Target
from panolog.orchestrator.watch.follower.watcher import Watcher
from panolog.scene.files import write_bytes
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.fakes import SetClock
from tests.orchestrator.history import BEGAN, append, begun

STARTED = TaskStarted(COARSE, 1, 0, "gpu1", 2, "cpu", 2, node_id="n1")


class Run:
    """A run whose records a test writes."""

    def __init__(self, root: Path) -> None:
        self.folder, self.clock = begun(root), SetClock()
        self.database = Database(self.folder.database, self.clock)

    def add(self, *records: Record, after: float = 1.0) -> None:
        self.clock.now += after
        self.database.append(records)

    def news(self, *, left: bool = False, stalled: float = 1e9) -> News:
        watcher = Watcher(self.folder, stalled)
        watcher.look()
        watcher.stall()
        return watcher.news(left=left)

    def kinds(self, *, left: bool = False, stalled: float = 1e9) -> list[str]:
        return [str(it.kind) for it in self.news(left=left, stalled=stalled).notifications]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    made = Run(tmp_path / "place")
    with closing(made.database):
        yield made


def lost(task: TaskId, node: str = "n1", reason: str = MACHINE_DIED) -> TaskFailed:
    return TaskFailed(task, 1, reason, final=False, kind=Failure.LOST, node=node)


def test_the_end_is_known_once_no_driver_is_at_work(run: Run) -> None:
    run.add(BEGAN, STARTED, EvaluationSaved("m", {"psnr": 31.25, "ssim": 0.9}), RunEnded(Outcome.DONE))
    assert run.kinds() == []
    (done,) = run.news(left=True).notifications
    assert done.kind == Kind.DONE
    assert (done.run, done.title) == ("place", "PanoLOG place: done")
    assert done.facts["metrics"] == {"psnr": 31.25, "ssim": 0.9}
    assert "PSNR 31.2" in done.text
    assert done.id == run.news(left=True).notifications[0].id


def test_a_run_that_fails_says_why_in_one_line(run: Run) -> None:
    run.add(BEGAN, STARTED, RunEnded(Outcome.FAILED, "block 1\nfailed " + "x" * 5000))
    (failed,) = run.news(left=True).notifications
    assert failed.text.startswith("block 1 failed")
    assert len(failed.text) == 1000


def test_a_driver_that_was_killed_is_a_failure_and_each_kill_one_of_its_own(run: Run) -> None:
    run.add(BEGAN, STARTED)
    (first,) = run.news(left=True).notifications
    assert first.kind == Kind.FAILED
    assert "killed" in first.text
    run.add(RunBegan("host", 2, resumed=True), STARTED)
    (second,) = run.news(left=True).notifications
    assert first.id != second.id


@pytest.mark.parametrize(
    "records",
    [
        [BEGAN, STARTED, RunEnded(Outcome.INTERRUPTED)],  # by its user
        [BEGAN, STARTED, PauseRequested(COARSE), TaskYielded(COARSE)],  # all that could happen is paused
        [BEGAN],  # in its preflight
    ],
)
def test_these_notify_of_nothing(run: Run, records: list[Record]) -> None:
    run.add(*records)
    interrupted = isinstance(records[-1], RunEnded)
    assert run.kinds(left=interrupted, stalled=1e9 if interrupted else 0.0) == []


def test_a_machine_that_leaves_is_one_notification_with_all_its_tasks(run: Run) -> None:
    block = TaskId.block(3)
    run.add(BEGAN, STARTED, TaskStarted(block, 1, 0, "gpu1", 3, "cpu", 2, node_id="n1"))
    run.add(lost(COARSE))
    run.add(lost(block))
    run.add(lost(block, reason="the worker process died: killed or crashed"))
    (gone,) = run.news().notifications
    assert gone.text == "gpu1 (n1) has left; it worked on coarse, block/003"
    run.add(lost(block), after=100)
    assert run.kinds() == ["preempted", "preempted"]


def test_a_machine_that_announces_its_end_is_one_notification(run: Run) -> None:
    run.add(BEGAN, STARTED, NodeLeaving("n1", "gpu1", Leaving.PREEMPTION, 120.0))
    (taken,) = run.news().notifications
    assert taken.kind == Kind.PREEMPTED
    assert taken.text.startswith("gpu1 (n1) leaves in 2:00: its provider takes it away")
    assert (taken.facts["node"], taken.facts["seconds"]) == ("gpu1", 120.0)
    run.add(lost(COARSE), NodeLeft("n1", "gpu1"))  # the task could not save in time
    assert run.kinds() == ["preempted"]
    run.add(NodeLeaving("n2", "gpu2", Leaving.REBALANCE), NodeLeaving("n3", "gpu3", Leaving.DRAIN))
    assert run.kinds() == ["preempted"]
    run.add(NodeLeaving("n2", "gpu2", Leaving.PREEMPTION))
    assert run.kinds() == ["preempted"] * 2
    run.add(TaskStarted(COARSE, 2, 0, "gpu3", 3, "cpu", 2, node_id="n3"), TaskYielded(COARSE, "gpu3"))
    assert run.kinds() == ["preempted"] * 3  # a node that drains is announced once it had a task
    run.add(TaskYielded(COARSE))
    assert run.kinds() == ["preempted"] * 3


def test_a_silent_run_is_stalled_once_for_each_silence(run: Run) -> None:
    run.add(BEGAN, STARTED)
    (stalled,) = run.news(stalled=0.0).notifications
    assert stalled.text.startswith("nothing has happened for")
    assert run.news(stalled=0.0).notifications[0].id == stalled.id
    run.add(Progressed(COARSE, 1, 10, 2.0))
    assert run.news(stalled=0.0).notifications[0].id != stalled.id
    assert run.kinds() == []


def test_a_run_that_waits_for_its_disk_says_so(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("panolog.orchestrator.watch.follower.watcher.WAITING_S", 0.0)
    run.add(BEGAN, STARTED)
    Presence(run.folder.presence).say("disk full, waiting: free 3 GiB")
    (stalled,) = run.news().notifications
    assert stalled.text.endswith(": disk full, waiting: free 3 GiB")


def test_a_folder_without_run_json_is_no_run(run: Run) -> None:
    run.add(BEGAN, STARTED, RunEnded(Outcome.FAILED, "wrong input"))
    run.folder.info.unlink()
    assert run.news(left=True) == News()


def test_curves_are_settled_up_to_a_checkpoint(run: Run) -> None:
    run.add(BEGAN, STARTED, Progressed(COARSE, 50, 100, 1.0))
    assert run.news().settled == {}
    run.add(CheckpointSaved(COARSE, 40, "p", 1))
    assert run.news().settled == {"coarse": 40}
    run.add(EvaluationSaved("m", {}))
    assert run.news().settled == {"coarse": 40, "eval": ALL}


def test_a_database_that_is_damaged_or_replaced_stops_no_watcher(run: Run) -> None:
    run.add(BEGAN, STARTED)
    watcher = Watcher(run.folder, 1e9)
    assert watcher.look()
    assert not watcher.look()
    first = watcher.run
    run.folder.database.unlink()
    assert not watcher.look()
    run.folder.database.write_bytes(b"x" * 5000)
    assert not watcher.look()
    run.folder.database.unlink()
    append(run.folder, RunBegan("host", 9, resumed=False), STARTED)
    assert watcher.look()
    assert watcher.run != first
    assert watcher.news().run == watcher.run


def test_a_limit_is_notified_when_it_is_near_and_when_it_has_ended_the_run(run: Run) -> None:
    run.add(BEGAN, STARTED, BudgetNear("the limit of 5 USD: 4.1 are used"))
    assert run.kinds() == ["over_budget"]
    assert "soon: the limit of 5 USD" in run.news().notifications[0].text
    reason = "the limit of 5 USD is reached"
    run.add(BudgetReached(reason), RunEnded(Outcome.LIMITED, reason))
    near, end = run.news(left=True).notifications
    assert (near.kind, end.kind) == (Kind.OVER_BUDGET, Kind.OVER_BUDGET)
    assert near.id != end.id
    assert "there is no model yet: the limit of 5 USD is reached" in end.text
    assert run.news(left=True).outcome == Outcome.LIMITED


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
