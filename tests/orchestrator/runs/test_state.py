from dataclasses import fields, is_dataclass
from itertools import zip_longest
from typing import Any, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from panolog.orchestrator.runs.database import from_json, to_json
from panolog.orchestrator.runs.money.records import BudgetReached, BudgetSet
from panolog.orchestrator.runs.records import (
    BlockPlan,
    CheckpointSaved,
    Merged,
    NodeQuarantined,
    Noticed,
    Outcome,
    Part,
    PlanSaved,
    PreflightSaved,
    Progressed,
    Record,
    RunBegan,
    RunEnded,
    Stored,
    TaskFailed,
)
from panolog.orchestrator.runs.state import Status, replay
from panolog.orchestrator.watch.views.summary import stage_of, summarize
from panolog.scene.errors import InputError
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import AGAIN, BEGAN, after, model, started

PLAIN = {int: st.integers(0, 2**40), float: st.floats(0, 1e9), str: st.text(max_size=9)}
TASKS = [COARSE, EVAL, TaskId.block(0), TaskId.block(1), TaskId.shard(0), TaskId.measure(0)]
FEW = st.integers(0, 9)  # tasks that are made
NAMES: dict[
    type, dict[str, st.SearchStrategy[Any]]
] = {  # of tasks in values that are text, and what is free in form
    PlanSaved: {"passes": st.just((("round/000",), ("repair/000",))), "measures": FEW},
    BudgetReached: {"measures": FEW},
    NodeQuarantined: {"tasks": st.just(("block/000",))},
    BudgetSet: {"prices": st.just({"currency": "USD"})},
    RunBegan: {"settings": st.just({"iterations": 2, "partition": {"cuts": [["x", 0.5, 2]]}})},
    PreflightSaved: {"settings": st.just({"width": None})},
}


def values(kind: Any) -> st.SearchStrategy[Any]:
    parts = get_args(kind)
    if kind is TaskId:
        return st.sampled_from(TASKS)
    if get_origin(kind) is tuple:
        return st.lists(values(parts[0]), max_size=2).map(tuple)
    if get_origin(kind) is dict:
        return st.dictionaries(values(parts[0]), values(parts[1]), max_size=2)
    if parts:
        return st.one_of(*map(values, parts))
    if is_dataclass(kind):
        return made(kind)
    return PLAIN[kind] if kind in PLAIN else st.from_type(kind)


def made(kind: Any) -> st.SearchStrategy[Any]:
    hints = get_type_hints(kind)
    of_fields = {field.name: values(hints[field.name]) for field in fields(kind)}
    return st.builds(kind, **of_fields | NAMES.get(kind, {}))


RECORDS = st.one_of(*map(made, get_args(Record)))


@settings(max_examples=30)
@given(st.tuples(*map(made, get_args(Record))))
def test_records_survive_json(one_of_each: tuple[Record, ...]) -> None:
    for record in one_of_each:
        assert from_json(type(record).__name__, to_json(record)) == record


def test_a_task_waits_and_runs_until_it_is_done_or_a_failure_is_final() -> None:
    begun: list[Record] = [BEGAN, started(COARSE)]
    assert (after(BEGAN).status(COARSE), after(*begun).status(COARSE)) == (Status.WAITING, Status.RUNNING)
    done = after(*begun, CheckpointSaved(COARSE, 20, "p", 1), model(COARSE)).task(COARSE)
    assert (done.status, done.checkpoint, done.seconds) == (Status.DONE, 20, 1.5)
    once = after(*begun, TaskFailed(COARSE, 1, "worker died", final=False)).task(COARSE)
    assert (once.status, once.retries, once.reasons) == (Status.WAITING, 1, ("worker died",))
    twice = after(started(COARSE, attempt=2), TaskFailed(COARSE, 2, "again", final=True)).task(COARSE)
    assert (twice.status, twice.attempts) == (Status.FAILED, 2)


def test_another_driver_takes_over_what_ran_and_retries_what_failed() -> None:
    records: list[Record] = [
        BEGAN,
        model(COARSE),
        started(TaskId.block(0)),
        TaskFailed(TaskId.block(1), 3, "no", final=True),
    ]
    state = after(*records, RunEnded(Outcome.FAILED, "block 1"), AGAIN)
    assert state.status(COARSE) == Status.DONE
    assert state.task(TaskId.block(0)).status == Status.WAITING
    assert (state.task(TaskId.block(1)).status, state.task(TaskId.block(1)).attempts) == (Status.WAITING, 0)
    assert state.task(TaskId.block(1)).reasons == ("no",)
    assert (state.outcome, state.reason) == (None, "")


def test_notices_are_kept_once_and_ten_thousand_are_not_compared_with_each_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert len(after(*[Noticed(COARSE, "a")] * 2, Noticed(COARSE, "b")).notices) == 2
    compared = 0

    def equal(one: Noticed, other: object) -> bool:
        nonlocal compared
        compared += 1
        return isinstance(other, Noticed) and vars(one) == vars(other)

    monkeypatch.setattr(Noticed, "__eq__", equal)
    state = after(*(Noticed(TaskId.block(i), "an image is left out") for i in range(10_000)))
    assert len(state.notices) == 10_000
    assert compared < 100


@given(st.lists(RECORDS, max_size=20), st.lists(made(Progressed), max_size=9))
def test_only_the_last_progress_of_each_task_matters(
    history: list[Record], progress: list[Progressed]
) -> None:
    mixed = [item for pair in zip_longest(history, progress) for item in pair if item is not None]
    stored = [Stored(i, float(i), record) for i, record in enumerate(mixed, 1)]
    last = {s.record.task: s.id for s in stored if isinstance(s.record, Progressed)}
    reduced = [s for s in stored if not isinstance(s.record, Progressed) or last[s.record.task] == s.id]
    assert replay(reduced) == replay(stored)


def test_summary_names_stage_and_end() -> None:
    """Times and what is killed: tests/orchestrator/watch/views/test_timing.py."""
    assert stage_of(after(model(COARSE), started(TaskId.shard(0)))) == "score"
    assert stage_of(after(model(COARSE), RunEnded(Outcome.DONE))) == "done"
    ends = [summarize(after(BEGAN, RunEnded(end)), running=False).label for end in Outcome]
    assert ends == ["done", "failed", "stopped", "ended early"]


def test_gaussians_in_training_and_gaussians_that_are_kept_are_different_numbers() -> None:
    zero, one = TaskId.block(0), TaskId.block(1)
    blocks = (BlockPlan(0, 3, 5, train=True), BlockPlan(1, 3, 3, train=True))
    records: list[Record] = [BEGAN, started(COARSE), Progressed(COARSE, 5, 10, 2.0, gaussians=7)]
    shown = summarize(after(*records), running=True)
    assert (shown.training_gaussians, shown.kept_gaussians) == (7, 7)
    records += [model(COARSE), PlanSaved("partition/plan.json", blocks)]  # 10, of them 2 sky
    records += [started(zero), Progressed(zero, 5, 10, 2.0, gaussians=12), started(one)]
    records += [Progressed(one, 5, 10, 2.0, gaussians=13)]
    shown = summarize(after(*records), running=True)
    assert (shown.training_gaussians, shown.kept_gaussians) == (25, 10)
    records += [model(zero)]  # 10 in the cell that had 5
    shown = summarize(after(*records), running=True)
    assert (shown.training_gaussians, shown.kept_gaussians) == (13, 15)
    shown = summarize(after(*records, Merged("point_cloud.ply", 20, 2, 100, 0.1)), running=False)
    assert (shown.training_gaussians, shown.kept_gaussians) == (None, 20)


def test_rows_of_older_runs_are_read() -> None:
    failed = '{"task":"block/000","attempt":1,"reason":"gone","final":false}'
    assert from_json("TaskFailed", failed) == TaskFailed(TaskId.block(0), 1, "gone", final=False)
    assert from_json("Noticed", '{"task":"preflight","message":"m"}') == Noticed(Part.PREFLIGHT, "m")
    assert from_json("Noticed", '{"task":"","message":"m"}') == Noticed(None, "m")
    assert to_json(Noticed(None, "m")) == '{"task":"","message":"m"}'
    plan = from_json("PlanSaved", '{"task":"plan","path":"plan.json","blocks":[]}')
    assert plan == PlanSaved("plan.json", ()) and not after(plan).measures
    done = '{"outcome":"done","reason":"","transient":false,"detail":"","task":""}'
    assert to_json(RunEnded(Outcome.DONE)) == done
    assert from_json("RunEnded", '{"outcome":"done","reason":"","task":""}') == RunEnded(Outcome.DONE)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("Unheard", "{}"),
        ("TaskYielded", '{"task":"nothing"}'),
        ("TaskYielded", '{"task":""}'),
        ("TaskYielded", '{"task":"report"}'),
        ("TaskYielded", '{"task":"plan","more":1}'),
        ("RunEnded", '{"outcome":"vanished","task":""}'),
        ("TaskYielded", "no JSON"),
    ],
)
def test_a_row_of_another_format_is_an_input_error(kind: str, text: str) -> None:
    with pytest.raises(InputError):
        from_json(kind, text)


def test_a_replay_with_passes_looks_at_each_task_a_few_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each model of a block used to be compared with all tasks of all passes."""
    looks, hashed = [0], TaskId.__hash__

    def counted(id: TaskId) -> int:
        looks[0] += 1
        return hashed(id)

    def looks_of(blocks: int) -> int:
        faces = [TaskId.repair(face) for face in range(2 * blocks)]
        plan = tuple(BlockPlan(block, 50, 1000, True) for block in range(blocks))
        tasks = [*map(TaskId.block, range(blocks)), TaskId.union(0), *faces]
        records: list[Record] = [
            BEGAN,
            model(COARSE),
            PlanSaved("", plan, (tuple(map(str, faces)),), 0),
            *map(model, tasks),
        ]
        stored = [Stored(number, 1.0, record) for number, record in enumerate(records)]
        looks[0] = 0
        replay(stored)
        return looks[0]

    monkeypatch.setattr(TaskId, "__hash__", counted)
    assert looks_of(400) < 2.2 * looks_of(200)
