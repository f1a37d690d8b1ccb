from dataclasses import replace
from typing import Any

import pytest

from panolog.orchestrator.engine.driver.policy import LOSSES, Consequence, after_failure, outcome, ready
from panolog.orchestrator.runs.machines.history import Misfortune
from panolog.orchestrator.runs.records import (
    BlockPlan,
    CheckpointSaved,
    EvaluationSaved,
    Failure,
    MeasuresSaved,
    Merged,
    Outcome,
    PlanSaved,
    Record,
    ScoresSaved,
    TaskFailed,
)
from panolog.orchestrator.runs.state import TaskState
from panolog.workers.tasks import COARSE, EVAL, MERGE, PLAN, TaskId
from tests.orchestrator.history import AGAIN, after, model, started

BLOCKS = (
    BlockPlan(0, cameras=4, gaussians=100, train=True),
    BlockPlan(1, cameras=9, gaussians=500, train=True),
    BlockPlan(2, cameras=0, gaussians=50, train=False),
    BlockPlan(3, cameras=7, gaussians=100, train=True),
)


STAGE_ONE = model(COARSE)
SCORES: list[Record] = [ScoresSaved(TaskId.shard(0), "a", 1), ScoresSaved(TaskId.shard(1), "b", 1)]
PLANNED = PlanSaved("plan.json", BLOCKS)
MODELS: list[Record] = [model(TaskId.block(block)) for block in (0, 1, 3)]
MERGED = Merged("point_cloud.ply", 1, 0, 1, 1.0)
EVALUATED = EvaluationSaved("metrics.json", {})


def next_tasks(*records: Record, districts: int = 1) -> tuple[TaskId, ...]:
    return ready(after(*records), shards=2, refine=True, districts=districts)


def end(*records: Record) -> tuple[Outcome, str] | None:
    return outcome(after(*records), next_tasks(*records))


def test_stages_follow_each_other() -> None:
    assert next_tasks() == (COARSE,)
    assert next_tasks(STAGE_ONE) == (TaskId.shard(0), TaskId.shard(1))
    assert next_tasks(STAGE_ONE, SCORES[1]) == (TaskId.shard(0),)
    assert next_tasks(STAGE_ONE, *SCORES) == (PLAN,)
    assert next_tasks(STAGE_ONE, *SCORES, PLANNED) == (TaskId.block(1), TaskId.block(3), TaskId.block(0))
    assert next_tasks(STAGE_ONE, *SCORES, PLANNED, *MODELS) == (MERGE,)
    assert next_tasks(STAGE_ONE, *SCORES, PLANNED, *MODELS, MERGED) == (EVAL,)
    assert next_tasks(STAGE_ONE, *SCORES, PLANNED, *MODELS, MERGED, EVALUATED) == ()


def test_shards_of_the_evaluation_come_before_it() -> None:
    shards = TaskId.measure(0), TaskId.measure(1)
    records: list[Record] = [STAGE_ONE, *SCORES, replace(PLANNED, measures=2), *MODELS]
    measured: list[Record] = [MeasuresSaved(shard, "a.json", 4, 0) for shard in shards]
    assert next_tasks(*records) == (MERGE,)
    assert next_tasks(*records, MERGED) == shards
    assert next_tasks(*records, MERGED, measured[0]) == shards[1:]
    assert next_tasks(*records, MERGED, *measured) == (EVAL,)
    assert end(*records, MERGED, *measured) is None
    assert end(*records, MERGED, *measured, EVALUATED) == ("done", "")
    failed = TaskFailed(shards[1], 3, "NaN", final=True)
    assert end(*records, MERGED, measured[0], failed) == ("failed", "measure/001 failed: NaN")
    outdated = [*records, MERGED, *measured, EVALUATED, MODELS[0], MERGED]
    assert next_tasks(*outdated) == shards


def test_districts_come_before_their_union() -> None:
    both = TaskId.district(0), TaskId.district(1)
    assert next_tasks(districts=2) == both
    assert next_tasks(model(both[0]), districts=2) == (both[1],)
    assert next_tasks(*map(model, both), districts=2) == (COARSE,)
    assert next_tasks(*map(model, both), STAGE_ONE, districts=2) == (TaskId.shard(0), TaskId.shard(1))
    assert end(TaskFailed(both[1], 3, "NaN", final=True)) == ("failed", "district/001 failed: NaN")


UNIONS = TaskId.union(0), TaskId.union(1)
ROUNDS = TaskId.round(0), TaskId.round(1)
REPAIRS = (TaskId.repair(0),)
PASSED = replace(PLANNED, passes=(tuple(map(str, ROUNDS)), tuple(map(str, REPAIRS))))
TRAINED: list[Record] = [STAGE_ONE, *SCORES, PASSED, *MODELS]


def test_each_pass_follows_a_union() -> None:
    records = list(TRAINED)
    for stage in (UNIONS[:1], ROUNDS, UNIONS[1:], REPAIRS):
        assert next_tasks(*records) == stage
        records += map(model, stage)
    assert next_tasks(*records) == (MERGE,)


def test_a_part_that_fails_in_a_pass_stays_as_it_was() -> None:
    failed = TaskFailed(ROUNDS[1], 3, "NaN", final=True)
    records: list[Record] = [*TRAINED, model(UNIONS[0]), model(ROUNDS[0]), failed]
    assert next_tasks(*records) == UNIONS[1:]
    over = [*records, model(UNIONS[1]), model(REPAIRS[0]), MERGED, EVALUATED]
    assert end(*over) == ("failed", "failed, so that part of the model stays as it was: round/001")


def test_what_was_made_of_an_older_model_is_made_again() -> None:
    """A block that was tried again outdates all that follows, a round the repairs, a repair the merge."""
    whole: list[Record] = [*map(model, (UNIONS[0], *ROUNDS, UNIONS[1], *REPAIRS)), MERGED]
    assert next_tasks(*TRAINED, *whole) == (EVAL,)
    assert next_tasks(*TRAINED, *whole, MODELS[0]) == UNIONS[:1]
    assert next_tasks(*TRAINED, *whole, model(ROUNDS[0])) == UNIONS[1:]
    assert next_tasks(*TRAINED, *whole, model(REPAIRS[0])) == (MERGE,)
    outdated = after(*TRAINED, *whole, EVALUATED, MODELS[0])
    assert not {MERGE, EVAL, *ROUNDS} & outdated.tasks.keys()
    assert (outdated.merged, outdated.metrics) == (None, None)


def test_a_block_is_part_of_a_model_from_its_union_on() -> None:
    block = TaskId.block(0)
    assert not after(*TRAINED).joined(block)
    united = after(*TRAINED, model(UNIONS[0]))
    assert united.joined(block) and not united.joined(ROUNDS[0])
    assert after(STAGE_ONE, PLANNED, *MODELS, MERGED).joined(block)


def test_nothing_starts_while_the_stage_before_runs_but_what_has_failed_for_good_holds_nothing_up() -> None:
    running = STAGE_ONE, *SCORES, PLANNED, *MODELS[1:], started(TaskId.block(0))
    assert (next_tasks(*running), end(*running)) == ((), None)
    failed = TaskFailed(TaskId.block(1), 3, "out of memory", final=True)
    records: list[Record] = [STAGE_ONE, *SCORES, PLANNED, MODELS[0], failed]
    assert next_tasks(*records) == (TaskId.block(3),)
    assert next_tasks(*records, MODELS[2]) == (MERGE,)


def test_failures_end_the_run_and_of_many_failed_blocks_the_first_are_named() -> None:
    assert end(TaskFailed(COARSE, 3, "NaN", final=True)) == ("failed", "coarse failed: NaN")
    assert end(TaskFailed(COARSE, 1, "NaN", final=False)) is None
    blocks = tuple(BlockPlan(block, 5, 5, train=True) for block in range(500))
    failed = [TaskFailed(TaskId.block(block.block), 3, "out of memory", final=True) for block in blocks]
    ended = end(STAGE_ONE, *SCORES, PlanSaved("partition/plan.json", blocks), *failed, MERGED, EVALUATED)
    reason = "block 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 490 more failed and keeps its Stage I Gaussians"
    assert ended == ("failed", reason)


GIB = 2**30


def consequence(task: TaskState, failure: Failure, **given: Any) -> Consequence:
    usual: dict[str, Any] = {"node": "a", "others": True, "retries": 2, "memory": 0, "largest": 0}
    return after_failure(task, failure, **usual | given)


def finals(failure: Failure, **counts: Any) -> bool:
    return consequence(TaskState(TaskId.block(0), **counts), failure).final


def test_retries_are_limited_and_a_death_is_none_but_counts_too() -> None:
    assert [finals(Failure.ERROR, errors=errors) for errors in range(4)] == [False, False, True, True]
    assert not finals(Failure.LOST, errors=2)
    assert not finals(Failure.ERROR, losses=LOSSES - 1)
    assert [finals(Failure.LOST, losses=losses) for losses in range(LOSSES + 1)] == [False] * LOSSES + [True]


def test_input_is_wrong_once_a_second_node_or_attempt_has_confirmed_it() -> None:
    found = TaskState(COARSE, errors=1, failures=(Misfortune(Failure.INPUT, ("a", "")),))
    again = Consequence(False, "tried again before the input counts as wrong")
    assert consequence(TaskState(COARSE), Failure.INPUT) == again
    assert not consequence(found, Failure.INPUT, node="a").final
    assert consequence(found, Failure.INPUT, node="b").final
    assert consequence(found, Failure.INPUT, node="a", others=False).final
    assert not consequence(
        replace(found, failures=(Misfortune(Failure.ERROR, ("b", "")),)), Failure.INPUT
    ).final


@pytest.mark.parametrize(
    ("allowed", "final"), [(2, [False, False, True]), (0, [True] * 3), (-1, [False] * 3)]
)
def test_preemptions_have_a_limit_of_their_own_and_none_by_default(allowed: int, final: list[bool]) -> None:
    task = TaskState(TaskId.block(0), losses=LOSSES)
    lost = [replace(task, preemptions=before) for before in range(3)]
    found = [consequence(each, Failure.LOST, preemptions=allowed) for each in lost]
    assert [each.final for each in found] == final == [not each.then for each in found]


def test_after_a_checkpoint_attempts_are_counted_anew() -> None:
    failures = [
        TaskFailed(COARSE, 1, "died", final=False, kind=Failure.LOST),
        TaskFailed(COARSE, 2, "NaN", final=False),
    ]
    task = after(*failures).task(COARSE)
    assert (task.errors, task.losses, task.retries) == (1, 1, 2)
    task = after(*failures, CheckpointSaved(COARSE, 7, "c", 1)).task(COARSE)
    assert (task.errors, task.losses, task.retries) == (0, 0, 2)


def test_memory_gets_shorter_step_by_step() -> None:
    failed = TaskFailed(
        COARSE, 1, "out of memory", final=False, kind=Failure.MEMORY, memory=8 * GIB, then="less"
    )
    task = TaskState(COARSE)
    first = consequence(task, Failure.MEMORY, memory=8 * GIB, largest=24 * GIB)
    assert (first.final, "smaller image cache" in first.then) == (False, True)
    task = after(failed).task(COARSE)
    assert (task.shortages, task.starved, task.reasons) == (1, 8 * GIB, ("out of memory; less",))
    second = consequence(task, Failure.MEMORY, memory=8 * GIB, largest=24 * GIB)
    assert (second.final, "larger device" in second.then) == (False, True)
    nowhere = consequence(task, Failure.MEMORY, memory=24 * GIB, largest=24 * GIB)
    assert (nowhere.final, "no device has more memory" in nowhere.then) == (True, True)
    anew = after(failed, failed, AGAIN).task(COARSE)  # a new driver holds nothing against a task
    assert (anew.errors, anew.shortages, anew.starved, anew.retries) == (0, 0, 0, 2)
