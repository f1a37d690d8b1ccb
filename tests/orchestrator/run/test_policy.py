from typing import Any

import pytest

from panolog.orchestrator.run.policy import (
    LOSSES,
    Verdict,
    after_failure,
    block_order,
    outcome,
    ready,
    shard_cameras,
)
from panolog.orchestrator.run.records import (
    ERROR,
    INPUT,
    LOST,
    MEMORY,
    BlockPlan,
    CheckpointSaved,
    EvaluationSaved,
    Merged,
    ModelSaved,
    PlanSaved,
    Record,
    RunBegan,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.run.state import RunState, TaskState, replay

BLOCKS = (
    BlockPlan(0, cameras=4, gaussians=100, train=True),
    BlockPlan(1, cameras=9, gaussians=500, train=True),
    BlockPlan(2, cameras=0, gaussians=50, train=False),
    BlockPlan(3, cameras=7, gaussians=100, train=True),
)


def model(task: str) -> ModelSaved:
    return ModelSaved(task, "model.ply", 1, 1, 1, 1.0)


COARSE = model("coarse")
SCORES: list[Record] = [ScoresSaved("score/000", "a", 1), ScoresSaved("score/001", "b", 1)]
PLAN = PlanSaved("plan.json", BLOCKS)
MODELS: list[Record] = [model(f"block/{block:03d}") for block in (0, 1, 3)]
MERGED = Merged("point_cloud.ply", 1, 0, 1, 1.0)
EVALUATED = EvaluationSaved("metrics.json", {})


def state(*records: Record) -> RunState:
    return replay(Stored(i, 0.0, record) for i, record in enumerate(records))


def next_tasks(*records: Record, refine: bool = True) -> tuple[str, ...]:
    return ready(state(*records), shards=2, refine=refine)


def end(*records: Record) -> tuple[str, str] | None:
    return outcome(state(*records), shards=2, refine=True)


def test_stages_follow_each_other() -> None:
    assert next_tasks() == ("coarse",)
    assert next_tasks(COARSE) == ("score/000", "score/001")
    assert next_tasks(COARSE, SCORES[1]) == ("score/000",)
    assert next_tasks(COARSE, *SCORES) == ("plan",)
    assert next_tasks(COARSE, *SCORES, PLAN) == ("block/001", "block/003", "block/000")
    assert next_tasks(COARSE, *SCORES, PLAN, *MODELS) == ("merge",)
    assert next_tasks(COARSE, *SCORES, PLAN, *MODELS, MERGED) == ("eval",)
    assert next_tasks(COARSE, *SCORES, PLAN, *MODELS, MERGED, EVALUATED) == ()


def test_nothing_starts_while_the_stage_before_runs() -> None:
    running = TaskStarted("block/000", 1, 0, "n", 1, "cpu", 1)
    assert next_tasks(COARSE, *SCORES, PLAN, *MODELS[1:], running) == ()
    assert end(COARSE, *SCORES, PLAN, *MODELS[1:], running) is None


def test_blocks_start_longest_first_and_empty_ones_not_at_all() -> None:
    assert block_order(state(PLAN)) == ("block/001", "block/003", "block/000")


def test_without_refinement_the_merge_follows_stage_one() -> None:
    assert next_tasks(COARSE, refine=False) == ("merge",)


def test_a_block_that_has_failed_for_good_holds_nobody_up() -> None:
    failed = TaskFailed("block/001", 3, "out of memory", final=True)
    records: list[Record] = [COARSE, *SCORES, PLAN, MODELS[0], failed]
    assert next_tasks(*records) == ("block/003",)
    assert next_tasks(*records, MODELS[2]) == ("merge",)
    assert end(*records, MODELS[2], MERGED, EVALUATED) == (
        "failed",
        "block 1 failed and keeps its Stage I Gaussians; `panolog resume` tries again",
    )


def test_other_failures_end_the_run_and_success_too() -> None:
    assert end(TaskFailed("coarse", 3, "NaN", final=True)) == ("failed", "coarse failed: NaN")
    assert end(TaskFailed("coarse", 1, "NaN", final=False)) is None
    assert end(COARSE, *SCORES, PLAN, *MODELS, MERGED, EVALUATED) == ("done", "")


@pytest.mark.parametrize(("count", "shards"), [(1, 1), (7, 3), (3, 9), (64, 4)])
def test_shards_hold_every_camera_once_in_order(count: int, shards: int) -> None:
    cameras = tuple(range(10, 10 + count))
    parts = shard_cameras(cameras, shards)
    assert sum(parts, ()) == cameras
    assert len(parts) == min(count, shards)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


GIB = 2**30


def verdict(task: TaskState, failure: str, *, memory: int = 0, largest: int = 0) -> Verdict:
    return after_failure(task, failure, retries=2, memory=memory, largest=largest)


def finals(failure: str, **counts: Any) -> bool:
    return verdict(TaskState("block/000", **counts), failure).final


def test_retries_are_limited_and_wrong_input_is_not_tried_again() -> None:
    assert [finals(ERROR, errors=errors) for errors in range(4)] == [False, False, True, True]
    assert finals(INPUT)


def test_a_death_is_not_held_against_the_task_but_not_for_ever() -> None:
    assert not finals(LOST, errors=2)
    assert not finals(ERROR, losses=LOSSES - 1)
    assert [finals(LOST, losses=losses) for losses in range(LOSSES + 1)] == [False] * LOSSES + [True]


def test_after_a_checkpoint_attempts_are_counted_anew() -> None:
    failures = [
        TaskFailed("coarse", 1, "died", final=False, kind=LOST),
        TaskFailed("coarse", 2, "NaN", final=False),
    ]
    task = state(*failures).task("coarse")
    assert (task.errors, task.losses, task.retries) == (1, 1, 2)
    task = state(*failures, CheckpointSaved("coarse", 7, "c", 1)).task("coarse")
    assert (task.errors, task.losses, task.retries) == (0, 0, 2)


def test_memory_gets_shorter_step_by_step() -> None:
    failed = TaskFailed("coarse", 1, "out of memory", final=False, kind=MEMORY, memory=8 * GIB, then="less")
    task = TaskState("coarse")
    first = verdict(task, MEMORY, memory=8 * GIB, largest=24 * GIB)
    assert (first.final, "smaller image cache" in first.then) == (False, True)
    task = state(failed).task("coarse")
    assert (task.shortages, task.starved, task.reasons) == (1, 8 * GIB, ("out of memory; less",))
    second = verdict(task, MEMORY, memory=8 * GIB, largest=24 * GIB)
    assert (second.final, "larger device" in second.then) == (False, True)
    nowhere = verdict(task, MEMORY, memory=24 * GIB, largest=24 * GIB)
    assert (nowhere.final, "no device has more memory" in nowhere.then) == (True, True)


def test_a_new_driver_holds_nothing_against_a_task() -> None:
    failed = TaskFailed("coarse", 1, "out of memory", final=False, kind=MEMORY, memory=8 * GIB)
    task = state(failed, failed, RunBegan("host", 2, resumed=True)).task("coarse")
    assert (task.errors, task.shortages, task.starved, task.retries) == (0, 0, 0, 2)
