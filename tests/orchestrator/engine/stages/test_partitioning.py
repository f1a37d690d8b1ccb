"""A place before and as it is partitioned: its outline, districts, blocks, and levels of detail of all."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from panolog.orchestrator.engine.stages import surroundings
from panolog.orchestrator.engine.stages.outline import write_outline
from panolog.orchestrator.engine.stages.partitioning import block_labels, plan_records
from panolog.orchestrator.engine.stages.surroundings import Surroundings
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import ModelSaved, Noticed, PlanSaved
from panolog.orchestrator.watch.views.plan_map import read_points
from panolog.partition.cells import Grid
from panolog.partition.levels import make_levels
from panolog.partition.plan import PartitionConfig, make_plan, read_plan
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply, write_ply
from panolog.scene.write import Offset, Origin, write_offset
from panolog.workers.events import Event, Trained
from panolog.workers.merge import retained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training.initialise import scene_gaussians, scene_length
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Harness, trained, well
from tests.prepare.world.stills import GPS, PLACE, write_still
from tests.workers.small import WIDTH, small_scene

CONFIG = RunConfig(width=64, blocks="2x1x1")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "scene").mkdir()
    return small_scene(tmp_path / "scene")


def test_the_outline_of_a_place_is_a_plan_of_one_block(scene: Scene, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    write_outline(folder, scene, CONFIG)
    plan = read_plan(folder.known_plan)
    assert (plan.grid.count, plan.rows) == (1, scene.train)
    assert plan.names == tuple(scene.panoramas[row].name for row in scene.train)
    np.testing.assert_array_equal(plan.centers, scene.centers[list(scene.train)])
    np.testing.assert_allclose(read_points(folder.outline_points), scene.points, atol=1e-6)
    written = folder.outline.read_bytes()
    write_outline(folder, replace(scene, train=scene.train[:3]), CONFIG)
    assert folder.outline.read_bytes() == written  # a resumed run keeps it
    write_outline(folder, replace(scene, train=scene.train[:3]), CONFIG, anew=True)
    assert read_plan(folder.outline).rows == scene.train[:3]
    assert not len(read_points(folder.outline_fixes))  # the scene does not say where it is


def test_gps_in_the_files_is_in_the_world_of_the_run(scene: Scene, tmp_path: Path) -> None:
    """What is subtracted from coordinates, by the scene and on reading, is subtracted from it too."""
    offset, far, folder = (5.0, -4.0, 3.0), (1000.0, 0.0, 0.0), RunFolder(tmp_path)
    latitude, longitude = 47 + (22 + 39.12 / 60) / 60, 8 + 32.5 / 60
    origin = Origin(latitude=latitude - 0.001, longitude=longitude, altitude=400.0)
    write_offset(scene.root, Offset(offset=offset, frame="ENU", origin=origin))
    level = {tag: value for tag, value in PLACE.items() if tag not in (GPS.GPSAltitude, GPS.GPSAltitudeRef)}
    panoramas = list(scene.panoramas)
    for row, place in enumerate((PLACE, level, None)):
        path = write_still(tmp_path / f"{row}.jpg", np.zeros((32, 64, 3), np.uint8), place=place)
        panoramas[row] = replace(panoramas[row], image=path)
    panoramas[3] = replace(panoramas[3], image=tmp_path / "gone.jpg")
    write_outline(folder, replace(scene, panoramas=tuple(panoramas), offset=far), CONFIG)
    north = 111.177  # metres of a thousandth of a degree there, by the series of the meridian
    wanted = np.array([[0, north, 8.5], [0, north, 0]]) - offset - far
    np.testing.assert_allclose(read_points(folder.outline_fixes), wanted, atol=0.05)
    (scene.root / "offset.json").write_text("nonsense")
    write_outline(folder, scene, CONFIG, anew=True)
    assert not len(read_points(folder.outline_fixes))


def test_of_many_points_some_are_kept(scene: Scene, tmp_path: Path) -> None:
    folder, many = RunFolder(tmp_path), scene.points.repeat(600, axis=0)
    write_outline(folder, replace(scene, points=many), CONFIG)
    assert 30_000 < len(read_points(folder.outline_points)) <= 50_000


def test_cameras_that_bound_no_place_have_no_outline(scene: Scene, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    write_outline(folder, replace(scene, train=scene.train[:1]), CONFIG)
    assert not folder.known_plan.exists() and not folder.outline.parent.exists()


# Districts of Stage I and their union; which blocks of a plan a run trains


BOTH = TaskId.district(0), TaskId.district(1)


def shifted(spec: TaskSpec) -> Iterator[Event]:
    """All goes well, and colours are those of the district."""
    if isinstance(spec, TrainSpec) and spec.cell is None:
        model = trained(spec)
        yield Trained(spec.task, replace(model, sh0=model.sh0 + spec.task.number), 2, 0.1)
    else:
        yield from well(spec)


def halves(folder: Path) -> Harness:
    folder.mkdir(exist_ok=True)
    return Harness(folder, districts=2, overlap=0.1, partition={"min_cameras": 2, "rho_tri": 0.1})


def test_districts_are_trained_apart_and_joined(tmp_path: Path) -> None:
    """Each gives what is in its cell, both the mean of their skies."""
    harness = halves(tmp_path)
    state, train = harness.drive(shifted), set(harness.job.scene.train)
    assert state.outcome == "done"
    assert harness.tasks[:2] == list(BOTH) and COARSE not in harness.tasks
    views = [set(harness.trainings(task)[0].views) for task in BOTH]
    assert views[0] | views[1] == train and views[0] != train != views[1]
    districts = harness.job.districts
    assert districts is not None
    coarse, models = read_ply(harness.folder.model(COARSE)), [read_ply(harness.folder.model(t)) for t in BOTH]
    kept = [retained(model, districts.cell(i), 0.0) for i, model in enumerate(models)]
    assert len(coarse) - coarse.sky == len(kept[0]) + len(kept[1]) == len(models[0]) - models[0].sky
    torch.testing.assert_close(coarse.sh0[coarse.scene], torch.cat([kept[0].sh0, kept[1].sh0]))
    torch.testing.assert_close(coarse.sh0[coarse.scene.stop :], models[0].sh0[models[0].scene.stop :] + 0.5)
    saved = [record for record in harness.records(ModelSaved) if record.task == COARSE]
    assert [(record.gaussians, record.path) for record in saved] == [(len(coarse), "coarse/model.ply")]


def test_a_sky_that_has_lost_rows_does_not_count(tmp_path: Path) -> None:
    harness = halves(tmp_path)

    def script(spec: TaskSpec) -> Iterator[Event]:
        for event in shifted(spec):
            if isinstance(event, Trained) and spec.task == BOTH[0]:
                model = event.gaussians
                yield replace(event, gaussians=model.select(torch.arange(len(model)) < len(model) - 1))
            else:
                yield event

    assert harness.drive(script).outcome == "done"
    coarse, second = (read_ply(harness.folder.model(task)) for task in (COARSE, BOTH[1]))
    assert coarse.sky == second.sky == 2
    torch.testing.assert_close(coarse.sh0[coarse.scene.stop :], second.sh0[second.scene.stop :])


def test_a_block_of_one_camera_is_not_trained_and_a_notice_says_so(tmp_path: Path) -> None:
    centers = np.array([[-3.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    names = [f"{row}.jpg" for row in range(4)]
    for least, train in ((3, [False, True]), (1, [True, True])):
        config = PartitionConfig(min_cameras=least)
        grid = Grid((2, 1, 1))
        scores = csr_array((4, 2))
        plan = make_plan(centers, centers, scores, grid, config, rows=range(4), names=names)
        *notices, saved = plan_records(RunFolder(tmp_path), plan, scores)
        assert isinstance(saved, PlanSaved)
        assert [block.train for block in saved.blocks] == train
        lines = [record.message for record in notices if isinstance(record, Noticed)]
        assert any("block 0 has 1 camera, fewer than" in line for line in lines) == (least > 1)


# Levels of detail


@pytest.mark.parametrize("rows", [7, 10_000])
def test_they_are_those_of_each_block_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    monkeypatch.setattr(surroundings, "_ROWS", rows)
    scene, path = small_scene(tmp_path / "scene"), tmp_path / "model.ply"
    start = scene_gaussians(scene)
    model = Gaussians(**start.tensors(), sky=11, exact=True)
    write_ply(path, model)
    config = RunConfig.model_validate({"blocks": "2x2x1", "stage2": {"exterior": "baked", "detail": 6.0}})
    found = Surroundings(scene, path, config, WIDTH)

    means = model.means[model.scene].numpy()
    labels = torch.from_numpy(block_labels(scene, means, config))
    sizes = torch.bincount(labels, minlength=4)
    assert found.sizes == tuple(sizes.tolist()) and sizes.min() > 0
    angle, cameras = 6.0 * 2 * math.pi / WIDTH, scene.train[:2]
    inside = torch.cat([labels, torch.full((model.sky,), -1)])
    parts = []
    for block in range(4):
        own = Gaussians(**model.select(inside == block).tensors(), sky=0, exact=True)
        levels = make_levels(own, angle * scene_length(scene), surroundings._LOW_PASS / 6.0)
        parts.append(levels.rows(levels.cut(scene.centers[list(cameras)], angle)))
    blocks = found.write_seen(tmp_path / "seen.ply", scene.centers[list(cameras)])
    seen = read_ply(tmp_path / "seen.ply")
    assert blocks.tolist() == np.repeat(range(4), list(map(len, parts))).tolist()
    assert seen.exact and seen.sky == 11 and len(seen) < len(model)
    for name, tensor in seen.tensors().items():
        expected = [*(part.tensors()[name] for part in parts), model.tensors()[name][model.scene.stop :]]
        assert torch.equal(tensor, torch.cat(expected)), name
