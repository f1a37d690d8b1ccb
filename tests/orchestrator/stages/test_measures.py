"""The evaluation in shards: what each gets, what becomes of it, and that it measures what one task does."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.dashboard import pictures
from panolog.orchestrator.driver.job import Job, Specs
from panolog.orchestrator.resources.pool import InProcess
from panolog.orchestrator.run.records import (
    EvaluationSaved,
    MeasuresSaved,
    Noticed,
    PlanSaved,
    SeamEvaluated,
)
from panolog.scene.errors import RunError
from panolog.scene.files import Locate, here
from panolog.scene.ply import read_ply
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import Event, LeftOut, LpipsMissing
from panolog.workers.specs import ModelFile, TaskSpec
from panolog.workers.tasks import EVAL, Stage, TaskId
from tests.orchestrator.fakes import DIED, Harness, fails, well
from tests.workers.small import small_scene

SHARDS = [TaskId.measure(0), TaskId.measure(1), TaskId.measure(2)]  # two of panoramas, one of a face


def measuring(folder: Path, points: int = 200, **settings: Any) -> Harness:
    """Two blocks of two cameras each, of whose five panoramas all are measured, with levels of detail."""
    folder.mkdir(exist_ok=True)
    partition = {"min_cameras": 2, "rho_tri": 0.5}
    stage2 = {"exterior": "frozen", "detail": 2.0}
    harness = Harness(folder, **{"partition": partition, "stage2": stage2, "retries": 1, **settings})
    scene = small_scene(folder / "scene", points=points)
    harness.job = Job(harness.folder, replace(scene, test=(0, 1, 2, 3, 4)), harness.job.config)
    return harness


def outcome(harness: Harness) -> dict[str, bytes]:
    """All files of the evaluation."""
    root = harness.folder.metrics.parent
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def specs(harness: Harness) -> list[EvaluateSpec]:
    return [spec for _, spec in harness.pool.started if isinstance(spec, EvaluateSpec)]


def truly(spec: TaskSpec) -> Iterator[Event]:
    """What is evaluated is rendered; all else goes well."""
    yield from spec.run() if isinstance(spec, EvaluateSpec) else well(spec)


def test_the_driver_joins_what_shards_have_measured(tmp_path: Path) -> None:
    harness, one = measuring(tmp_path / "shards"), measuring(tmp_path / "one", stage2={"exterior": "frozen"})
    assert harness.drive().outcome == one.drive().outcome == "done"
    assert harness.tasks[-3:] == SHARDS and one.tasks[-1] == EVAL
    assert [spec.views for spec in specs(harness)] == [(0, 1), (2, 3, 4), ()]
    assert [len(spec.faces) for spec in specs(harness)] == [0, 0, 1]
    files, expected = outcome(harness), outcome(one)
    shards = [f"shards/{number:03d}.json" for number in range(3)]
    assert sorted(files) == sorted([*expected, *shards])
    assert json.loads(files.pop("metrics.json")) == json.loads(expected.pop("metrics.json")) | {"detail": 1.0}
    assert {name: files[name] for name in expected} == expected
    saved = harness.records(MeasuresSaved)
    counts = [(record.task, record.views, record.faces) for record in saved]
    assert counts == [(SHARDS[0], 2, 0), (SHARDS[1], 3, 0), (SHARDS[2], 0, 1)]
    assert [record.path for record in saved] == [f"eval/{name}" for name in shards]
    assert harness.records(EvaluationSaved) == one.records(EvaluationSaved)
    assert [record.task for record in harness.records(SeamEvaluated)] == SHARDS[2:]
    assert [view["name"] for view in pictures.views(harness.folder.database)["views"]] == [
        panorama.name for panorama in harness.job.scene.panoramas
    ]


def test_they_measure_what_one_task_does_with_fewer_gaussians(tmp_path: Path) -> None:
    harness = measuring(tmp_path / "shards", points=4_000)
    one = measuring(tmp_path / "one", points=4_000, stage2={"exterior": "frozen"})
    sizes: dict[TaskId, int] = {}

    def script(spec: TaskSpec) -> Iterator[Event]:
        if isinstance(spec, EvaluateSpec):
            sizes[spec.task] = len(spec.model.load())
            if spec.seams is not None:
                assert len(spec.seams.coarse.load()) < 4_000
        yield from truly(spec)

    harness.drive(script)
    one.drive(truly)
    whole = read_ply(harness.folder.point_cloud)
    assert sizes.keys() == set(SHARDS) and all(whole.sky < size < len(whole) for size in sizes.values())
    found, expected = (json.loads(each.folder.metrics.read_bytes()) for each in (harness, one))
    assert found["views"].keys() == expected["views"].keys()
    for name, metrics in expected["views"].items():
        for key, value in metrics.items():  # a fit of colours moves with small differences of a poor render
            allowed = 0.02 if key.startswith("cc_") else 0.005
            assert found["views"][name][key] == pytest.approx(value, abs=allowed), (name, key)
    said = [
        [n for n in each.records(Noticed) if n.message == found["lpips_reason"]] for each in (harness, one)
    ]
    assert said[0] == said[1] and len(said[0]) == (found["lpips_reason"] is not None)


class _Noting(InProcess):
    """Takes the place of a pool, and notes which files a task is given."""

    def __init__(self) -> None:
        self.scene: set[Path] = set()
        self.run: set[Path] = set()

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        self.scene, self.run = set(scene), set(run)
        return here


def test_a_shard_gets_its_own_panoramas_and_no_model_of_the_whole_place(tmp_path: Path) -> None:
    harness, noting = measuring(tmp_path), _Noting()
    harness.drive()
    folder, panoramas = harness.folder, harness.job.scene.panoramas
    specs = Specs(harness.job, noting)

    def files(rows: Iterable[int]) -> set[Path]:
        return {file for row in rows for file in panoramas[row].files}

    spec = specs.of(SHARDS[0])
    assert isinstance(spec, EvaluateSpec) and spec.model == ModelFile(folder.seen(SHARDS[0]))
    shared = noting.scene, noting.run
    given = [spec.locate, spec.model.locate]
    assert shared == (files(spec.views), {folder.seen(SHARDS[0])}) and given == [here, here]
    spec = specs.of(SHARDS[2])
    assert isinstance(spec, EvaluateSpec) and spec.seams is not None
    assert spec.seams.coarse == ModelFile(folder.seen_coarse(SHARDS[2]))
    assert noting.scene == files(harness.job.scene.train)
    assert noting.run == {folder.seen(SHARDS[2]), folder.seen_coarse(SHARDS[2])}


def test_a_worker_that_dies_measures_again(tmp_path: Path) -> None:
    harness, whole = measuring(tmp_path / "died"), measuring(tmp_path / "whole")
    whole.drive()
    name = harness.job.scene.panoramas[0].name
    lost = LeftOut(SHARDS[0], f"{name} is left out", name)  # what an attempt that is over has said is nothing
    assert harness.drive(fails(SHARDS[0], DIED, 1, before=[lost])).outcome == "done"
    assert harness.tasks.count(SHARDS[0]) == 2
    assert outcome(harness) == outcome(whole)


def test_a_shard_that_keeps_failing_fails_the_run(tmp_path: Path) -> None:
    harness = measuring(tmp_path)
    with pytest.raises(RunError, match="measure/001 failed"):
        harness.drive(fails(SHARDS[1], DIED, 9))
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.tasks == SHARDS[1:]


def test_what_is_left_out_and_why_lpips_is_missing_is_in_the_metrics(tmp_path: Path) -> None:
    harness = measuring(tmp_path)
    name = harness.job.scene.panoramas[2].name

    def script(spec: TaskSpec) -> Iterator[Event]:
        events = list(well(spec))
        if spec.task in SHARDS[:2]:
            yield LpipsMissing(spec.task, "no lpips here")
        if spec.task == SHARDS[1]:
            events[0] = LeftOut(spec.task, f"{name} is left out: truncated", name)
        yield from events

    harness.drive(script)
    metrics = json.loads(harness.folder.metrics.read_bytes())
    assert metrics["lpips_reason"] == "no lpips here"
    assert metrics["left_out"] == {name: f"{name} is left out: truncated"}
    assert len(metrics["views"]) == 4
    said = [notice for notice in harness.records(Noticed) if "lpips" in notice.message]
    assert said == [Noticed(EVAL, "no lpips here")]


def test_a_block_that_is_tried_again_is_measured_again(tmp_path: Path) -> None:
    harness, whole = measuring(tmp_path / "again"), measuring(tmp_path / "whole")
    whole.drive()
    with pytest.raises(RunError, match="block 1 failed"):
        harness.drive(fails(TaskId.block(1), DIED, 9))
    assert harness.folder.metrics.exists()
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.tasks == [TaskId.block(1), *SHARDS]
    assert outcome(harness) == outcome(whole)


def test_shards_of_another_evaluation_are_not_joined(tmp_path: Path) -> None:
    harness = measuring(tmp_path)

    def script(spec: TaskSpec) -> Iterator[Event]:
        if spec.task == SHARDS[2]:
            first, second = (harness.folder.shard(task) for task in SHARDS[:2])
            first.write_bytes(second.read_bytes())
        yield from well(spec)

    with pytest.raises(RunError, match="has shards of another evaluation; `panolog eval"):
        harness.drive(script)


def test_a_run_whose_plan_knows_no_shards_is_evaluated_as_one_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an older version has left it."""
    harness = measuring(tmp_path)
    with monkeypatch.context() as older:
        older.setattr("panolog.orchestrator.driver.job.Specs.measures", ())
        with pytest.raises(KeyboardInterrupt):
            harness.drive(_stops_in_block)
    assert [record.measures for record in harness.records(PlanSaved)] == [0]
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.tasks[-1] == EVAL
    assert "detail" not in json.loads(harness.folder.metrics.read_bytes())


def _stops_in_block(spec: TaskSpec) -> Iterator[Event]:
    if spec.task.stage is Stage.BLOCK:
        raise KeyboardInterrupt
    yield from well(spec)


def test_no_model_of_a_shard_is_left(tmp_path: Path) -> None:
    harness = measuring(tmp_path)

    def script(spec: TaskSpec) -> Iterator[Event]:
        if spec.task.stage is Stage.MEASURE:
            assert harness.folder.seen(spec.task).exists()
            assert harness.folder.seen_coarse(spec.task).exists() == (spec.task == SHARDS[2])
        yield from well(spec)

    harness.drive(script)
    assert not list(harness.folder.metrics.parent.rglob("*.ply"))
