"""Times and statuses that a run shows: true while it runs, and at rest without a driver."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from panolog.orchestrator.runs.money.records import BudgetReached, BudgetSet
from panolog.orchestrator.runs.records import (
    BlockPlan,
    EvaluationSaved,
    MeasuresSaved,
    Merged,
    ModelSaved,
    Outcome,
    PlanSaved,
    PreflightSaved,
    Preparing,
    Progressed,
    Record,
    RunBegan,
    RunContinued,
    RunEnded,
    RunWaiting,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState, replay
from panolog.orchestrator.watch.views.history import History
from panolog.orchestrator.watch.views.run_view import RunView, StageView, view_run
from panolog.orchestrator.watch.views.summary import summarize
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import started

INFO = {"config": {"blocks": "2x1x1", "refine": True}}
ZERO, ONE, SHARD = TaskId.block(0), TaskId.block(1), TaskId.shard(0)
ESTIMATE = PreflightSaved(
    "preflight.json", {"coarse": 100.0, "score": 10.0, "block": 200.0, "merge": 4.0, "eval": 6.0}
)
PLANNED = PlanSaved("partition/plan.json", (BlockPlan(0, 3, 5, train=True), BlockPlan(1, 3, 5, train=True)))
Timed = tuple[float, Record]


def began(previous: float | None = None) -> RunBegan:
    return RunBegan("host", 7, resumed=previous is not None, previous=previous)


def model(task: TaskId, seconds: float) -> ModelSaved:
    return ModelSaved(task, "model.ply", 10, 100, 100, seconds)


def at(task: TaskId, iteration: int, rate: float = 1.0) -> Progressed:
    return Progressed(task, iteration, 100, rate)


def stored(records: Sequence[Timed]) -> list[Stored]:
    return [Stored(number, time, record) for number, (time, record) in enumerate(records, 1)]


def state(records: Sequence[Timed]) -> RunState:
    return replay(stored(records))


def view(records: Sequence[Timed], *, running: bool) -> RunView:
    return view_run(History.of(stored(records)), INFO, running=running)


def stage(shown: RunView, name: str) -> StageView:
    return next(stage for stage in shown.stages if stage.name == name)


STAGE_ONE: list[Timed] = [
    (0, began()),
    (1, Preparing("starting Ray")),
    (5, Preparing("calibrating")),
    (10, ESTIMATE),
    (12, started(COARSE)),
    (60, at(COARSE, 50)),
    (112, model(COARSE, 100.0)),
]
STAGE_TWO: list[Timed] = [
    *STAGE_ONE,
    (113, started(SHARD)),
    (120, ScoresSaved(SHARD, "scores", 3)),
    (121, PLANNED),
    (125, started(ZERO)),
    (125, started(ONE)),
    (145, at(ZERO, 20)),
    (150, at(ONE, 25)),
]


TRAINED: list[Timed] = [*STAGE_TWO, (205, model(ONE, 75)), (205, model(ZERO, 80))]
MERGED = Merged("point_cloud.ply", 10, 2, 100, 0.1)
SHARDED: list[Timed] = [  # an evaluation in three parts
    (205, replace(ESTIMATE, seconds=ESTIMATE.seconds | {"measure": 12.0})),
    (205, replace(PLANNED, measures=3)),
]
PART = TaskId.measure(0)
MEASURED: list[Timed] = [
    (206, started(PART)),
    (208, at(PART, 50, rate=10.0)),
    (210, MeasuresSaved(PART, "000.json", 3, 0)),
]


CUT: list[Timed] = [
    *STAGE_TWO,
    (152, model(ONE, 27.0)),
    (155, TaskYielded(ZERO)),
    (156, BudgetReached("max_cost")),
]
AFTER: list[Timed] = [*CUT, (160, MERGED), (161, started(EVAL)), (170, EvaluationSaved("metrics.json", {}))]
EARLY: list[Timed] = [
    *STAGE_ONE[:-1],
    (80, TaskYielded(COARSE)),
    (80, BudgetReached("deadline")),
    (84, MERGED),
]
AGAIN: list[Timed] = [
    *AFTER[:-1],
    (162, RunEnded(Outcome.LIMITED, "max_cost")),
    (300, began(162)),
    (300, BudgetSet()),
    (305, started(ZERO, 20)),
]
DONE_THEN: list[Timed] = [*AGAIN, (350, model(ZERO, 80)), (356, MERGED)]
NO_MEMORY: list[Timed] = [(160, TaskFailed(ZERO, 3, "no memory", final=True)), (170, model(ONE, 40.0))]
NAN: list[Timed] = [*STAGE_ONE[:-1], (70, TaskFailed(COARSE, 3, "NaN", final=True))]
# Records, whether a driver is at work, a stage, and its status, begin, end, seconds, and tasks that are done.
STAGES: dict[str, tuple[list[Timed], bool, str, tuple[object, ...]]] = {
    "a killed run ends with its last record": (STAGE_TWO, False, "block", ("stopped", 125, 150, 25, 0)),
    "what was done stays": (STAGE_TWO, False, "calibrate", ("done", 1, 10, 9, 0)),
    "what is to come waits": (STAGE_TWO, False, "merge", ("waiting", None, None, None, 0)),
    "an interrupted preflight": (STAGE_ONE[:3], False, "calibrate", ("stopped", 1, 5, 4, 0)),
    "a live preflight": (STAGE_ONE[:3], True, "calibrate", ("running", 1, None, None, 0)),
    "a failed block": (
        [*STAGE_TWO, *NO_MEMORY, (171, RunEnded(Outcome.FAILED, "block 0"))],
        *(False, "block", ("failed", 125, 170, 45, 1)),
    ),
    "a failed Stage I": (
        [*NAN, (71, RunEnded(Outcome.FAILED, "NaN"))],
        *(False, "coarse", ("failed", 12, 70, 58, 0)),
    ),
    "a limit ends the training": (CUT, True, "block", ("stopped", 125, 156, 31, 1)),
    "what follows changes it no more": (AFTER, False, "block", ("stopped", 125, 156, 31, 1)),
    "no time is in two stages: merge": (AFTER, False, "merge", ("done", 156, 160, 4, 1)),
    "no time is in two stages: evaluation": (AFTER, False, "eval", ("done", 161, 170, 9, 1)),
    "a limit ends Stage I": (EARLY, True, "coarse", ("stopped", 12, 80, 68, 0)),
    "a merge after that": (EARLY, True, "merge", ("done", 80, 84, 4, 1)),
    "a higher limit continues it": (AGAIN, True, "block", ("running", 125, None, None, 1)),
    "and makes the merge anew": (AGAIN, True, "merge", ("waiting", None, None, None, 0)),
    "with an end of its own": (DONE_THEN, True, "block", ("done", 125, 350, 87, 2)),
    "and a merge of its own": (DONE_THEN, True, "merge", ("done", 350, 356, 6, 1)),
    "no time counts without a driver": (
        [*STAGE_TWO, (1000, began(previous=150)), (1010, started(ZERO, 20)), (1030, at(ZERO, 30))],
        *(False, "block", ("stopped", 125, 1030, 55, 0)),
    ),
}


@pytest.mark.parametrize("case", STAGES)
def test_a_stage_has_a_status_and_times(case: str) -> None:
    records, running, name, expected = STAGES[case]
    found = stage(view(records, running=running), name)
    seconds = None if found.status == "running" else found.seconds  # until now
    assert (found.status, found.began, found.ended, seconds, found.done) == expected


def test_a_killed_run_says_what_is_known() -> None:
    shown = view(STAGE_TWO, running=False)
    assert [stage.status for stage in shown.stages] == ["done"] * 4 + ["stopped"] + ["waiting"] * 2
    summary = shown.summary
    said = (summary.status, summary.label, summary.seconds, summary.eta)
    assert said == ("stopped", "driver lost", 150, None)
    assert summary.reason == "the driver, process 7 on host, was killed or has crashed"
    (task,) = (task for task in summary.tasks if task.name == "block/000")
    assert (task.status, task.seconds) == ("waiting", 25)
    assert view(STAGE_ONE[:3], running=True).summary.step == "calibrating"


def test_elapsed_leaves_out_the_time_without_a_driver() -> None:
    killed = [*STAGE_TWO, (1000, began(previous=150)), (1010, started(ZERO, 20))]
    shown = summarize(state(killed), running=True, now=1020.0)
    assert shown.seconds == 150 + 20
    stopped = [*STAGE_TWO, (155, RunEnded(Outcome.INTERRUPTED)), (1000, RunBegan("host", 9, resumed=True))]
    of_an_older_version = summarize(state(stopped), running=True, now=1020.0)
    assert of_an_older_version.seconds == 155 + 20


def test_the_seconds_of_a_task_are_of_all_its_attempts() -> None:
    records: list[Timed] = [
        *STAGE_TWO,
        (155, TaskYielded(ONE)),
        (1000, began(previous=160)),
        (1005, started(ZERO, 20)),
        (1005, started(ONE, 25)),
        (1025, TaskFailed(ONE, 1, "worker died", final=False)),
        (1030, started(ONE, 25)),
    ]
    ended = [*records, (1050, model(ZERO, 40.0))]
    shown = summarize(state(ended), running=True, now=1060.0)
    assert [task.seconds for task in shown.tasks] == [100, 7, None, 35 + 40, 30 + 20 + 30]


@pytest.mark.parametrize(
    ("records", "now", "eta"),
    [
        (STAGE_ONE[:4], 11, 320),  # before the first worker: as estimated
        (STAGE_ONE[:5], 22, 310),  # without a rate: less what has passed
        (STAGE_ONE[:6], 60, 48 + 0.96 * 220),  # at its mean rate, and what is to come is as much quicker
        (STAGE_ONE, 112, 220),  # between two stages
        (STAGE_TWO[:8], 115, 8 + 210),  # scoring
        (STAGE_TWO[:10], 121, 210),  # after the plan
        (STAGE_TWO, 150, 0.8 * (0.36 * 200 + 0.64 * 125) + 10),  # the later of two blocks
        (TRAINED, 205, 10),
        ([*TRAINED, (206, MERGED), (206, started(EVAL))], 208, 4),
        ([*TRAINED, *SHARDED, (206, MERGED)], 206, 12 + 6),
        ([*TRAINED, *SHARDED, (206, MERGED), *MEASURED[:2]], 209, 12 - 3 + 6),
        ([*TRAINED, *SHARDED, (206, MERGED), *MEASURED], 212, 12 * 2 / 3 + 6),
        ([(0, began()), (1, started(COARSE)), (2, at(COARSE, 50))], 2, None),  # Stage II has no estimate
        ([*STAGE_TWO, (210, MERGED), (212, RunEnded(Outcome.DONE))], 213, None),
    ],
)
def test_the_time_left_is_that_of_the_whole_run(records: list[Timed], now: float, eta: float | None) -> None:
    assert summarize(state(records), running=True, now=now).eta == pytest.approx(eta)


@pytest.mark.parametrize(
    ("records", "now"), [(STAGE_ONE[:5], 22.0), (STAGE_ONE, 112.0), (STAGE_TWO, 150.0), (TRAINED, 205.0)]
)
def test_progress_is_the_share_of_the_time_that_is_over(records: list[Timed], now: float) -> None:
    shown = summarize(state(records), running=True, now=now)
    assert shown.seconds is not None and shown.eta is not None
    assert shown.progress == pytest.approx(shown.seconds / (shown.seconds + shown.eta))
    killed = summarize(state(records), running=False, now=now + 9_999)
    assert 0 < killed.progress <= shown.progress  # it has ended with its last record
    assert summarize(state([*records, (now, RunEnded(Outcome.DONE))]), running=False).progress == 1.0


def test_a_run_without_an_estimate_has_no_progress_but_what_its_preparation_says() -> None:
    early = STAGE_ONE[:3]
    none, little, more = (
        summarize(state(early), running=True, now=9, prepared=over) for over in (None, 0.001, 0.25)
    )
    assert (none.progress, none.eta) == (0, None)
    assert (little.progress, little.eta) == (0.001, None)  # too early to say
    assert more.seconds is not None and (more.progress, more.eta) == (0.25, 3 * more.seconds)


def test_the_more_of_a_task_is_done_the_more_its_own_pace_counts() -> None:
    """It takes 200 s where 100 were estimated; what follows is then expected to take twice as long, too."""
    found = []
    for done in (1, 10, 25, 50, 90):
        records: list[Timed] = [*STAGE_ONE[:5], (12 + 2 * done, at(COARSE, done, rate=5.0))]
        eta = summarize(state(records), running=True, now=12 + 2 * done).eta
        assert eta is not None
        found.append(eta / (200 - 2 * done + 2 * 220))
    assert found == sorted(found) and found[0] == pytest.approx(0.5, abs=0.01)
    assert found[2:] == pytest.approx([1, 1, 1])


def test_while_a_run_waits_its_progress_stands_still_and_there_is_no_time_left() -> None:
    why = "waiting: block 1 is paused"
    paused: list[Timed] = [
        *STAGE_TWO,
        (160, TaskYielded(ONE)),
        (205, model(ZERO, 80)),
        (205, RunWaiting(why)),
    ]
    soon, late = (summarize(state(paused), running=True, now=now) for now in (206.0, 9_999.0))
    assert (late.label, late.waiting, late.eta) == (why, why, None)
    assert late.progress == soon.progress > 0.5
    again = summarize(state([*paused, (306, RunContinued(101.0))]), running=True, now=307.0)
    assert (again.label, again.waiting) == ("running", "") and again.eta is not None
    shut = "waiting: every machine is in quarantine; gpu-a: 3 tasks have failed there in a row"
    (label, full) = ("waiting: every machine is in quarantine", "disk full, waiting: free 2.0 GiB")
    assert summarize(state([*STAGE_TWO, (151, RunWaiting(shut))]), running=True, now=152.0).label == label
    assert summarize(state([*STAGE_TWO, (151, RunWaiting(full))]), running=True, now=152.0).label == "waiting"


def test_the_shards_of_an_evaluation_are_a_stage() -> None:
    parts = [*TRAINED, *SHARDED, (206, MERGED)]
    begun = view([*parts, *MEASURED[:2]], running=True)
    measuring = stage(begun, "measure")
    found = (measuring.label, measuring.status, measuring.tasks, measuring.done)
    assert found == ("measurement", "running", 3, 0)
    assert measuring.progress == pytest.approx(0.5 / 3)
    assert not [each for each in view(TRAINED, running=True).stages if each.name == "measure"]
    every = [(211, MeasuresSaved(TaskId.measure(part), "", 3, 0)) for part in (1, 2)]
    ended = view([*parts, *MEASURED, *every], running=True)
    assert stage(ended, "measure").status == "done" and ended.summary.stage == "measure"
