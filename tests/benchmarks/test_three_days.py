"""What the checks of the simulated run of days notice."""

import pytest

from benchmarks.three_days.checks import Life, Sent, wrong
from benchmarks.three_days.faults import Host, Period
from panolog.orchestrator.run.records import CheckpointSaved, Record, Stored, TaskFailed
from panolog.workers.tasks import TaskId
from tests.orchestrator.history import BEGAN, model, started

TASK = TaskId.block(0)


def sent(*kinds: tuple[str, int], begin: float = 0.0) -> list[Sent]:
    return [Sent(begin + 100.0 * i, TASK, kind, value, "") for i, (kind, value) in enumerate(kinds)]


def stored(*records: Record, begin: float = 0.0) -> list[Stored]:
    """Each when the message of `sent` at its place was taken; before them the start of the run."""
    made = [Stored(i, EPOCH + begin + 100.0 * (i - 1), record) for i, record in enumerate(records, 1)]
    return made if begin else [Stored(0, EPOCH, BEGAN), *made]


EPOCH = 1e9
STARTED, MODEL = started(TASK), model(TASK)
SAVED = CheckpointSaved(TASK, 500, "path", 1)
WHOLE = sent(("Hello", 0), ("Checkpoint", 500), ("Trained", 0))
QUIET = [Life(0.0, 1000.0, killed=False)]
KILLED = [Life(0.0, 200.0, killed=True), Life(290.0, 1000.0, killed=False)]


@pytest.mark.parametrize(
    ("records", "right"),
    [
        ((STARTED, SAVED, MODEL), True),
        ((STARTED, MODEL), False),  # lost
        ((STARTED, SAVED, SAVED, MODEL), False),  # doubled
        ((SAVED, STARTED, MODEL), False),  # in another order
        ((STARTED, SAVED, MODEL, TaskFailed(TASK, 1, "why", final=False)), False),  # never sent
    ],
)
def test_lost_doubled_and_invented_records_are_noticed(records: tuple[Record, ...], right: bool) -> None:
    assert (not list(wrong(WHOLE, stored(*records), QUIET))) == right


def test_a_kill_loses_the_messages_of_its_moment_alone() -> None:
    assert list(wrong(WHOLE, stored(STARTED, SAVED), KILLED)) == []
    lost = "block/000: Checkpoint 500 of 0.028 h is not recorded"
    assert list(wrong(WHOLE, stored(STARTED), KILLED)) == [lost]
    assert list(wrong(WHOLE, stored(STARTED, SAVED), QUIET)) == [
        "block/000: Trained 0 of 0.056 h is not recorded"
    ]


def test_what_a_kill_has_lost_is_not_taken_for_what_the_next_driver_was_sent() -> None:
    """The next one takes the same message again, and must record it."""
    lost = [Life(0.0, 0.0, killed=True), Life(90.0, 1000.0, killed=False)]
    lines = [*sent(("Hello", 0)), *sent(("Hello", 0), ("Trained", 0), begin=110.0)]
    again = stored(STARTED, MODEL, begin=110.0)
    assert list(wrong(lines, [*stored(), *again], lost)) == []
    assert list(wrong(lines, [*stored(STARTED), *again], lost)) == []
    assert list(wrong(lines, [*stored(STARTED), *again[1:]], lost)) == [
        "block/000: Hello 0 of 0.031 h is not recorded"
    ]


def test_a_machine_that_comes_back_is_another_node() -> None:
    host = Host("a", "GPU", 1, 1.0, (Period(0, 100), Period(500, 1000)))
    assert [host.node(time) for time in (0, 99, 120, 200, 600)] == [0, 0, 0, None, 1]
    assert host.missing(Period(50, 550)) == 400
