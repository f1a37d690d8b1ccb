"""What a run shows of its place before anything is trained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from panolog.orchestrator.engine.stages.outline import write_outline
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.plan_map import read_points
from panolog.partition.plan import read_plan
from panolog.scene.model import Scene
from tests.workers.small import small_scene

CONFIG = RunConfig(width=64, blocks="2x1x1")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "scene").mkdir()
    return small_scene(tmp_path / "scene")


def test_the_outline_of_a_place_is_a_plan_of_one_block(scene: Scene, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    write_outline(folder, scene, CONFIG)
    plan = read_plan(folder.known_plan)
    assert (plan.grid.count, plan.rows) == (1, scene.train)
    assert plan.names == tuple(scene.panoramas[row].name for row in scene.train)
    np.testing.assert_array_equal(plan.centers, scene.centers[list(scene.train)])
    np.testing.assert_allclose(read_points(folder.outline_points), scene.points, atol=1e-6)
    written = folder.outline.read_bytes()
    write_outline(folder, replace(scene, train=scene.train[:3]), CONFIG)
    assert folder.outline.read_bytes() == written  # a resumed run keeps it


def test_of_many_points_some_are_kept(scene: Scene, tmp_path: Path) -> None:
    folder, many = RunFolder(tmp_path / "run"), scene.points.repeat(600, axis=0)
    write_outline(folder, replace(scene, points=many), CONFIG)
    assert 30_000 < len(read_points(folder.outline_points)) <= 50_000


def test_cameras_that_bound_no_place_have_no_outline(scene: Scene, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    write_outline(folder, replace(scene, train=scene.train[:1]), CONFIG)
    assert not folder.known_plan.exists() and not folder.outline.parent.exists()
