import pytest

from panolog.orchestrator.policy import (
    Machine,
    Share,
    block_order,
    may_retry,
    outcome,
    ready,
    shard_cameras,
    share,
)
from panolog.orchestrator.records import (
    BlockPlan,
    EvaluationSaved,
    Merged,
    ModelSaved,
    PlanSaved,
    Record,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.state import RunState, replay

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


@pytest.mark.parametrize(
    ("tasks", "cpus", "fit", "each"),
    [(1, 2, 9, 2), (2, 2, 9, 1), (3, 2, 9, 1), (2, 16, 9, 8), (64, 16, 9, 1), (4, 16, 2, 8), (5, 4, 1, 4)],
)
def test_cores_are_shared_on_the_cpu(tasks: int, cpus: int, fit: int, each: int) -> None:
    machine = Machine(cpus, node_cpus=cpus, gpus=0, gpu_cpus=0, memory=None)
    assert share(tasks, machine, device="cpu", fit=fit) == Share(each, 0)


def test_no_task_asks_for_more_than_the_largest_node_has() -> None:
    cluster = Machine(cpus=24, node_cpus=16, gpus=3, gpu_cpus=4, memory=None)
    assert share(1, cluster, device="cpu", fit=24) == Share(16, 0)
    assert share(9, cluster, device="cuda", fit=1) == Share(4, 1)


@pytest.mark.parametrize(("count", "shards"), [(1, 1), (7, 3), (3, 9), (64, 4)])
def test_shards_hold_every_camera_once_in_order(count: int, shards: int) -> None:
    cameras = tuple(range(10, 10 + count))
    parts = shard_cameras(cameras, shards)
    assert sum(parts, ()) == cameras
    assert len(parts) == min(count, shards)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_retries_are_limited_and_wrong_input_is_not_tried_again() -> None:
    assert [may_retry(n, 2, user_error=False) for n in (1, 2, 3)] == [True, True, False]
    assert not may_retry(1, 2, user_error=True)
