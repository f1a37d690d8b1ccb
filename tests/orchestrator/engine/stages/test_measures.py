"""The evaluation in shards: what each gets, what becomes of it, and that it measures what one task does."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.engine.driver.job import Job, Specs
from panolog.orchestrator.engine.stages.evaluation import Evaluation
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import (
    EvaluationSaved,
    MeasuresSaved,
    Noticed,
    PlanSaved,
    SeamEvaluated,
)
from panolog.orchestrator.watch.dashboard import pictures
from panolog.scene.errors import RunError
from panolog.scene.files import here
from panolog.scene.ply import read_ply, write_ply
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import Evaluated, Event, LeftOut, LpipsMissing, SeamMeasured
from panolog.workers.seams.schema import parse_seams
from panolog.workers.specs import ModelFile, TaskSpec
from panolog.workers.tasks import EVAL, TaskId
from panolog.workers.training.initialise import scene_gaussians
from tests.orchestrator.fakes import DIED, Harness, Noting, begins, fails, well
from tests.workers.seams.test_schema import FACES
from tests.workers.small import WIDTH, small_scene

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


def truly(spec: TaskSpec) -> Iterator[Event]:
    """What is evaluated is rendered; all else goes well."""
    yield from spec.run() if isinstance(spec, EvaluateSpec) else well(spec)


def test_the_driver_joins_what_shards_have_measured(tmp_path: Path) -> None:
    harness, one = measuring(tmp_path / "shards"), measuring(tmp_path / "one", stage2={"exterior": "frozen"})
    assert harness.drive().outcome == one.drive().outcome == "done"
    assert harness.tasks[-3:] == SHARDS and one.tasks[-1] == EVAL
    specs = [spec for _, spec in harness.pool.started if isinstance(spec, EvaluateSpec)]
    assert [(spec.views, len(spec.faces)) for spec in specs] == [((0, 1), 0), ((2, 3, 4), 0), ((), 1)]
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


def test_a_shard_gets_its_own_panoramas_and_no_model_of_the_whole_place(tmp_path: Path) -> None:
    harness, noting, there = measuring(tmp_path), Noting(), list[bool]()
    folder, panoramas = harness.folder, harness.job.scene.panoramas

    def script(spec: TaskSpec) -> Iterator[Event]:
        if spec.task in SHARDS:
            there.extend(path.exists() for path in (folder.seen(spec.task), folder.seen_coarse(spec.task)))
        yield from well(spec)

    harness.drive(script)
    assert there == [True, False, True, False, True, True]
    assert not list(folder.metrics.parent.rglob("*.ply"))  # none of them is left
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


def test_a_worker_that_dies_measures_again_and_a_shard_that_keeps_failing_fails_the_run(
    tmp_path: Path,
) -> None:
    harness, whole = measuring(tmp_path / "died"), measuring(tmp_path / "whole")
    whole.drive()
    name = harness.job.scene.panoramas[0].name
    lost = LeftOut(SHARDS[1], f"{name} is left out", name)  # what an attempt that is over has said is nothing
    with pytest.raises(RunError, match="measure/001 failed"):
        harness.drive(fails(SHARDS[1], DIED, 9, before=[lost]))
    assert harness.drive(fails(SHARDS[1], DIED, 1, before=[lost]), resumed=True).outcome == "done"
    assert harness.tasks.count(SHARDS[1]) == 2 and SHARDS[0] not in harness.tasks
    assert outcome(harness) == outcome(whole)


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


def test_shards_of_another_evaluation_are_not_joined(tmp_path: Path) -> None:
    harness = measuring(tmp_path)

    first, second = (harness.folder.shard(task) for task in SHARDS[:2])
    with pytest.raises(RunError, match="has shards of another evaluation; `panolog eval"):
        harness.drive(begins(SHARDS[2], lambda: first.write_bytes(second.read_bytes())))


def test_a_run_whose_plan_knows_no_shards_is_evaluated_as_one_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an older version has left it."""
    harness = measuring(tmp_path)
    with monkeypatch.context() as older:
        older.setattr("panolog.orchestrator.engine.driver.job.Specs.measures", ())
        with pytest.raises(KeyboardInterrupt):
            harness.drive(begins(TaskId.block(0), lambda: harness.stop.signal()))  # noqa: PLW0108  # a new one
    assert [record.measures for record in harness.records(PlanSaved)] == [0]
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.tasks[-1] == EVAL
    assert "detail" not in json.loads(harness.folder.metrics.read_bytes())


# What an evaluation keeps of the events of its task


def test_seams_are_written_with_their_pictures_and_count_for_completeness(tmp_path: Path) -> None:
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path)
    write_ply(tmp_path / "model.ply", scene_gaussians(scene))
    evaluation = Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, folder, faces=1)
    evaluation.add(LeftOut(EVAL, "damaged", scene.panoramas[scene.test[0]].name))
    evaluation.add(LeftOut(EVAL, "damaged too", scene.panoramas[scene.train[0]].name))
    assert not evaluation.complete
    evaluation.add(SeamMeasured(EVAL, FACES[0], {"merged.jpg": b"a picture"}))
    assert evaluation.complete
    evaluation.save(folder)
    assert parse_seams(folder.seams.read_bytes()) == FACES[:1]
    assert (folder.seam(0, 1) / "merged.jpg").read_bytes() == b"a picture"
    assert list(evaluation.report()["left_out"].values()) == ["damaged"]


def test_what_is_measured_at_fitted_poses_stands_next_to_the_metrics(tmp_path: Path) -> None:
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path)
    write_ply(tmp_path / "model.ply", scene_gaussians(scene))
    shards, whole = [TaskId.measure(0), TaskId.measure(1)], replace(scene, test=(3, 4))
    for shard, row in zip(shards, whole.test, strict=True):
        part = Evaluation(whole, tmp_path / "model.ply", WIDTH, 0.0, None, rows=(row,))
        there: dict[str, float | None] = {"psnr": 24.0 + row, "pixels": row / 2}
        part.add(Evaluated(shard, scene.panoramas[row].name, {"psnr": 20.0}, b"", there))
        part.save_shard(folder, shard)
    joined = Evaluation(whole, tmp_path / "model.ply", WIDTH, 0.0, None)
    joined.join(folder, shards)
    report = joined.report()
    assert report["mean"] == {"psnr": 20.0}
    assert report["pose_fit"]["mean"] == {"psnr": 27.5, "pixels": 1.75}
    assert report["pose_fit"]["views"]["pano_4.png"] == {"psnr": 28.0, "pixels": 2.0}
    plain = Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, None)
    plain.add(Evaluated(EVAL, "pano_4.png", {"psnr": 20.0}, b""))
    assert "pose_fit" not in plain.report()
