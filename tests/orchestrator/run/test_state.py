import pytest
from hypothesis import given
from hypothesis import strategies as st

from panolog.orchestrator.run.records import (
    BlockPlan,
    CheckpointSaved,
    EvaluationSaved,
    Merged,
    ModelSaved,
    Noticed,
    PauseRequested,
    PlanSaved,
    PreviewSaved,
    Progressed,
    Record,
    RetryRequested,
    RunBegan,
    RunEnded,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
    UnpauseRequested,
    ViewEvaluated,
    from_json,
    to_json,
)
from panolog.orchestrator.run.state import DONE, FAILED, RUNNING, WAITING, RunState, replay
from panolog.orchestrator.views.summary import stage_of, summarize

BEGAN = RunBegan("host", 1, resumed=False)
AGAIN = RunBegan("host", 2, resumed=True)


def started(task: str, attempt: int = 1) -> TaskStarted:
    return TaskStarted(task, attempt, 0, "node", 7, "cpu", 1)


def model(task: str) -> ModelSaved:
    return ModelSaved(task, f"{task}/model.ply", 10, 100, 30, 1.5)


def after(*records: Record) -> RunState:
    return replay(Stored(i, float(i), record) for i, record in enumerate(records, 1))


EVERY_RECORD: list[Record] = [
    BEGAN,
    started("coarse"),
    Progressed("coarse", 5, 10, 2.0, loss=0.5, gaussians=3, rates={"means": 1e-4}),
    PreviewSaved("coarse", 5, "a.jpg", "coarse/previews/000005.jpg"),
    Noticed("coarse", "a.jpg is left out"),
    CheckpointSaved("coarse", 5, "coarse/checkpoint.safetensors", 9),
    model("coarse"),
    ScoresSaved("score/000", "partition/scores/000.npz", 4),
    PlanSaved("partition/plan.json", (BlockPlan(0, 3, 5, train=True), BlockPlan(1, 0, 2, train=False))),
    TaskFailed("block/000", 1, "gone", final=False, detail="trace"),
    Merged("point_cloud.ply", 10, 2, 100, 0.1),
    ViewEvaluated("eval", "a.jpg", {"psnr": 20.0, "lpips": None}),
    EvaluationSaved("eval/metrics.json", {"psnr": 20.0, "lpips": None}),
    PauseRequested("block/000"),
    UnpauseRequested("block/000"),
    RetryRequested("block/000"),
    TaskYielded("block/000"),
    RunEnded("done"),
]


@pytest.mark.parametrize("record", EVERY_RECORD, ids=lambda record: type(record).__name__)
def test_records_survive_json(record: Record) -> None:
    assert from_json(type(record).__name__, to_json(record)) == record


def test_a_task_goes_from_waiting_to_running_to_done() -> None:
    assert after(BEGAN).status("coarse") == WAITING
    assert after(BEGAN, started("coarse")).status("coarse") == RUNNING
    done = after(BEGAN, started("coarse"), CheckpointSaved("coarse", 20, "p", 1), model("coarse")).task(
        "coarse"
    )
    assert (done.status, done.checkpoint, done.seconds) == (DONE, 20, 1.5)


def test_a_failed_attempt_waits_again_until_it_is_final() -> None:
    once = after(started("coarse"), TaskFailed("coarse", 1, "worker died", final=False)).task("coarse")
    assert (once.status, once.retries, once.reasons) == (WAITING, 1, ("worker died",))
    twice = after(started("coarse", 2), TaskFailed("coarse", 2, "again", final=True)).task("coarse")
    assert (twice.status, twice.attempts) == (FAILED, 2)


def test_another_driver_takes_over_what_ran_and_retries_what_failed() -> None:
    records: list[Record] = [
        BEGAN,
        model("coarse"),
        started("block/000"),
        TaskFailed("block/001", 3, "no", final=True),
    ]
    state = after(*records, RunEnded("failed", "block 1"), AGAIN)
    assert state.status("coarse") == DONE
    assert state.task("block/000").status == WAITING
    assert (state.task("block/001").status, state.task("block/001").attempts) == (WAITING, 0)
    assert state.task("block/001").reasons == ("no",)
    assert (state.outcome, state.reason) == (None, "")


def test_a_new_model_outdates_merge_and_metrics() -> None:
    merged = Merged("point_cloud.ply", 10, 2, 100, 0.1)
    state = after(merged, EvaluationSaved("eval/metrics.json", {"psnr": 20.0}), model("block/001"))
    assert (state.status("merge"), state.status("eval")) == (WAITING, WAITING)
    assert (state.merged, state.metrics) == (None, None)


def test_repeated_notices_are_kept_once() -> None:
    assert len(after(*[Noticed("coarse", "a")] * 2, Noticed("coarse", "b")).notices) == 2


@given(st.lists(st.tuples(st.integers(0, len(EVERY_RECORD) - 1), st.sampled_from("abc"))))
def test_only_the_last_progress_of_each_task_matters(history: list[tuple[int, str]]) -> None:
    stored = []
    for i, (kind, task) in enumerate(history, 1):
        record = EVERY_RECORD[kind]
        if isinstance(record, Progressed):
            record = Progressed(task, i, 100, 1.0)
        stored.append(Stored(i, float(i), record))
    last = {s.record.task: s.id for s in stored if isinstance(s.record, Progressed)}
    reduced = [s for s in stored if not isinstance(s.record, Progressed) or last[s.record.task] == s.id]
    assert replay(reduced) == replay(stored)


def test_summary_names_stage_status_and_time_left() -> None:
    state = after(BEGAN, started("coarse"), Progressed("coarse", 25, 100, 5.0, loss=0.1))
    told = summarize(state, running=True, now=11.0).model_dump(mode="json")
    assert (told["status"], told["stage"], told["eta"], told["seconds"]) == ("running", "coarse", 15.0, 10.0)
    assert told["tasks"][0]["status"] == RUNNING
    killed = summarize(state, running=False, now=11.0).model_dump(mode="json")
    assert (killed["status"], killed["stage"], killed["eta"], killed["seconds"]) == (
        "stopped",
        "coarse",
        None,
        2,
    )
    assert (killed["tasks"][0]["status"], killed["tasks"][0]["eta"]) == (WAITING, None)
    assert stage_of(after(model("coarse"), started("score/000"))) == "score"
    assert stage_of(after(model("coarse"), RunEnded("done"))) == "done"
