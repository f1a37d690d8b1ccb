"""The driver with workers that yield what the test specifies, without Ray."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from panolog.orchestrator.engine.driver.attempts import WorkerSpec
from panolog.orchestrator.engine.driver.driver import Hooks
from panolog.orchestrator.engine.scheduling.pool import Failed
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import (
    Failure,
    Outcome,
    PreviewSaved,
    RunEnded,
    SeamEvaluated,
    StopRequested,
    TaskFailed,
)
from panolog.orchestrator.runs.state import Status
from panolog.orchestrator.runs.thinning import PREVIEWS
from panolog.orchestrator.watch.dashboard import pictures
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.partition.plan import read_plan
from panolog.scene.errors import InputError, RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_header, ply_offset, read_ply
from panolog.workers.events import Checkpoint, Event, Preview
from panolog.workers.merge import retained
from panolog.workers.scoring import ScoreSpec
from panolog.workers.seams.schema import parse_seams
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, EVAL, Stage, TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import DIED, CrashError, Harness, SetClock, begins, fails, well

TRUNCATED = Failed("a.jpg is truncated", Failure.INPUT)


def test_a_run_ends_with_everything_in_its_place(harness: Harness) -> None:
    state = harness.drive()
    assert harness.tasks == [COARSE, TaskId.shard(0), *sorted(harness.tasks[2:4]), EVAL]
    assert harness.pool.placement(COARSE).threads == 2
    assert [where.threads for where, spec in harness.pool.started if spec.task.stage is Stage.BLOCK] == [1, 1]
    assert (state.outcome, state.metrics) == ("done", {"psnr": 24.0, "lpips": None})
    assert ply_header(harness.folder.point_cloud) == (202, 2)
    for path in (harness.folder.plan, harness.folder.scores):
        assert path.is_file()
    assert len(list(harness.folder.images.iterdir())) == len(harness.job.scene.test)
    (face,) = parse_seams(harness.folder.seams.read_bytes())
    assert harness.records(SeamEvaluated) == [SeamEvaluated(EVAL, "0|1", face.seam)]
    assert not list(harness.folder.root.rglob("checkpoint.safetensors"))
    assert harness.state == state


def test_messages_are_handled_between_two_starts_that_take_long(tmp_path: Path) -> None:
    """Else a notice that a machine leaves would expire while hundreds of blocks are started."""
    harness = Harness(tmp_path, (Node("node", "host", 8, 2**40),), blocks="2x2x1")
    harness.clock = clock = SetClock()
    begun = list[int]()

    def slow(spec: WorkerSpec) -> TaskSpec:
        if spec.task.stage is Stage.BLOCK:
            running = [task for task in harness.state.tasks.values() if task.status == Status.RUNNING]
            begun.append(len(harness.pool.running) - len(running))
            clock.sleep(60)
        return spec

    assert harness.drive(hooks=Hooks(on_start=slow)).outcome == "done"
    assert begun == [0] * 4  # when one is started, all before it have said Hello


def test_of_many_previews_the_first_the_latest_and_some_between_are_kept(harness: Harness) -> None:
    previews = (Preview(COARSE, iteration, "1.jpg", b"\xff\xd8\xff") for iteration in range(500, 30_001, 500))
    harness.drive(begins(COARSE, *previews))
    paths = [record.path for record in harness.records(PreviewSaved)]
    kept = [path for path in paths if (harness.folder.root / path).exists()]
    assert len(paths) == 60
    assert len(kept) == len(list(harness.folder.previews(COARSE).iterdir())) == PREVIEWS
    assert (kept[0], kept[-1]) == (paths[0], paths[-1])
    entry = RunEntry(harness.folder.root.parent, harness.folder.root.name)
    shown = [preview["iteration"] for preview in pictures.previews(entry, "coarse")["previews"]]
    assert [harness.folder.relative(harness.folder.preview(COARSE, at)) for at in shown] == kept[::-1]
    assert pictures.previews(entry, None)["previews"][0]["iteration"] == 30_000


def test_a_snapshot_of_stage_one_is_kept_until_its_model_is_there(harness: Harness) -> None:
    folder, tensors, seen = harness.folder, {"x": torch.arange(4.0)}, list[tuple[int, dict[str, Any]]]()

    def preview(iteration: int) -> Preview:
        saved = Checkpoint(COARSE, iteration, tensors)
        return Preview(COARSE, iteration, "a.jpg", b"\xff\xd8\xff", held_out=True, snapshot=saved)

    def look() -> None:
        found = checkpoint.load(folder.snapshot(COARSE))
        seen.append((found.iteration, found.tensors))

    plain = Preview(COARSE, 50, "b.jpg", b"\xff\xd8\xff")
    assert harness.drive(begins(COARSE, preview(10), preview(30), look, plain)).outcome == "done"
    ((iteration, found),) = seen
    assert iteration == 30 and torch.equal(found["x"], tensors["x"])
    assert not folder.snapshot(COARSE).exists()
    assert [(it.view, it.held_out) for it in harness.records(PreviewSaved)] == [
        ("a.jpg", True),
        ("a.jpg", True),
        ("b.jpg", False),
    ]


@pytest.mark.parametrize(("failed", "attempts"), [(DIED, 3), (TRUNCATED, 2)], ids=["retries", "confirmed"])
def test_a_block_that_keeps_failing_keeps_its_stage_one_gaussians_until_it_is_resumed(
    harness: Harness, tmp_path: Path, failed: Failed, attempts: int
) -> None:
    with pytest.raises(RunError, match="block 1 failed and keeps its Stage I Gaussians"):
        harness.drive(fails(TaskId.block(1), failed, 99))
    assert harness.tasks.count(TaskId.block(1)) == attempts
    assert [harness.state.status(TaskId.block(n)) for n in (0, 1)] == [Status.DONE, Status.FAILED]
    assert harness.state.outcome == "failed"
    assert ply_header(harness.folder.point_cloud) == (202, 2)  # nothing is missing
    assert harness.folder.metrics.exists()
    kept = read_ply(harness.folder.kept(1))
    merged = read_ply(harness.folder.point_cloud)
    assert any(torch.equal(row, kept.sh0[0]) for row in merged.sh0)
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.tasks == [TaskId.block(1), EVAL]
    undisturbed = harness.at(tmp_path / "other")
    undisturbed.drive()
    assert harness.folder.point_cloud.read_bytes() == undisturbed.folder.point_cloud.read_bytes()


def test_wrong_input_ends_the_run_once_a_second_attempt_has_confirmed_it(harness: Harness) -> None:
    with pytest.raises(InputError, match=r"a\.jpg is truncated"):
        harness.drive(fails(COARSE, TRUNCATED, 99))
    assert [failed.final for failed in harness.records(TaskFailed)] == [False, True]
    assert harness.records(StopRequested) == [StopRequested(0)]
    assert harness.records(RunEnded) == [RunEnded(Outcome.FAILED, "a.jpg is truncated")]


def test_a_worker_that_ends_without_a_result_has_failed(harness: Harness) -> None:
    def script(spec: TaskSpec) -> Iterator[Event]:
        yield from well(spec) if spec.task != COARSE or len(harness.pool.started) > 1 else ()

    assert harness.drive(script).outcome == "done"
    assert harness.state.task(COARSE).reasons == ("the worker ended without a result",)


def test_a_worker_that_dies_after_its_result_has_done_its_work(harness: Harness) -> None:
    def script(spec: TaskSpec) -> Iterator[Event]:
        yield from well(spec)
        if spec.task != EVAL:
            raise CrashError(DIED)

    assert harness.drive(script).outcome == "done"
    assert harness.tasks.count(COARSE) == 1
    assert not harness.records(TaskFailed)
    assert not list(harness.folder.root.rglob("checkpoint.safetensors"))


@pytest.mark.parametrize("refine", [True, False])
def test_every_ply_notes_the_offset_of_the_scene_and_without_refinement_it_is_stage_one(
    tmp_path: Path, refine: bool
) -> None:
    harness, offset = Harness(tmp_path, refine=refine), (465_000.0, 5_250_000.0, 408.0)
    harness.job = replace(harness.job, scene=replace(harness.job.scene, offset=offset))
    harness.drive()
    models = harness.folder.model(COARSE), harness.folder.point_cloud
    assert [ply_offset(path) for path in models] == [offset] * 2
    if not refine:
        assert harness.tasks == [COARSE, EVAL]
        assert models[0].read_bytes() == models[1].read_bytes()
    assert harness.folder.metrics.exists() and harness.folder.seams.exists() == refine


@pytest.mark.parametrize("exterior", ["full", "frozen", "baked"])
def test_a_block_starts_from_what_its_cameras_can_distinguish(tmp_path: Path, exterior: str) -> None:
    harness = Harness(tmp_path, stage2={"exterior": exterior, "detail": 20.0})
    found: dict[TaskId, Gaussians] = {}

    def script(spec: TaskSpec) -> Iterator[Event]:
        if isinstance(spec, TrainSpec) and spec.initial is not None and spec.task.stage is Stage.BLOCK:
            found[spec.task] = spec.initial.load()
        yield from well(spec)

    harness.drive(script)
    coarse, plan = read_ply(harness.folder.model(COARSE)), read_plan(harness.folder.plan)
    assert len(found) == 2
    for task, initial in found.items():
        own, all_own = (retained(it, plan.cell(task.number), 0.0) for it in (initial, coarse))
        assert sorted(own.means.tolist()) == sorted(all_own.means.tolist())
        assert torch.equal(initial.means[-2:], coarse.means[-2:])
        if exterior == "full":
            assert len(initial) == len(coarse)
        else:
            assert len(own) == initial.scene.stop
            assert 2 < initial.sky < 2 + (len(coarse) - len(own)) / 2
    assert not list(harness.folder.root.rglob("initial.ply"))
    assert ply_header(harness.folder.point_cloud) == (202, 2)


@pytest.mark.parametrize("exterior", ["full", "baked"])
def test_a_shard_is_scored_with_what_its_cameras_can_distinguish(tmp_path: Path, exterior: str) -> None:
    harness = Harness(tmp_path, stage2={"exterior": exterior, "detail": 40.0})
    found: list[tuple[Gaussians, NDArray[np.int64], tuple[int, ...] | None]] = []

    def script(spec: TaskSpec) -> Iterator[Event]:
        if isinstance(spec, ScoreSpec):
            found.append((spec.model.load(), spec.labels.load(), spec.sizes))
        yield from well(spec)

    harness.drive(script)
    ((model, labels, sizes),), coarse = found, read_ply(harness.folder.model(COARSE))
    assert len(model) == len(labels) + model.sky
    assert torch.equal(model.sh0[model.scene.stop :], coarse.sh0[coarse.scene.stop :])
    if exterior == "full":
        assert (len(model), sizes) == (len(coarse), None)
    else:
        assert len(model) < len(coarse)
        assert sizes == tuple(read_plan(harness.folder.plan).gaussians)
        assert not list((harness.folder.root / "partition").rglob("*.ply"))
