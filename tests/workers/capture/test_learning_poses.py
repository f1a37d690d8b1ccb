"""Trainings that refine poses, on a card as on the CPU."""

from dataclasses import replace

import numpy as np
import pytest

from panolog.workers.capture.captured import Captured, joined
from panolog.workers.training.trainer import TrainSpec
from tests.renderer.cuda.stubbed import stubbed
from tests.workers.small import WIDTH, small_scene
from tests.workers.training.test_pipeline import Emulated
from tests.workers.trainings import coarse_of, end, settings

POSES = {"refine": True, "begin": 0.1, "visits": 0}


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> TrainSpec:
    scene = small_scene(tmp_path_factory.mktemp("scene"), points=60)
    config = settings(sky={"count": 20}, densify={"until": 0}, poses=POSES)
    return coarse_of(scene, config, width=WIDTH // 2, iterations=14)


@pytest.fixture(scope="module")
def learnt(spec: TrainSpec) -> Captured:
    captured = end(spec).captured
    assert captured is not None
    return captured


def poses(captured: Captured | None) -> np.ndarray:
    assert captured is not None and captured.poses is not None
    return captured.poses


def before(spec: TrainSpec) -> np.ndarray:
    """(4, 3, 4) poses of the views as they are given."""
    panoramas = spec.scene.load().panoramas
    return np.stack(
        [np.column_stack((panoramas[row].rotation, panoramas[row].translation)) for row in range(4)]
    )


def test_cameras_move(spec: TrainSpec, learnt: Captured) -> None:
    assert learnt.rows.tolist() == sorted(spec.views) == [0, 1, 2, 3]
    assert 1e-5 < np.abs(poses(learnt) - before(spec)).max() < 0.1
    turned = poses(learnt)[:, :, :3]
    assert np.einsum("nij,nkj->nik", turned, turned) == pytest.approx(np.tile(np.eye(3), (len(turned), 1, 1)))
    still = replace(spec, config=settings(poses={"refine": False}), iterations=2)
    assert end(still).captured is None


@pytest.mark.system
def test_a_card_learns_as_the_cpu(spec: TrainSpec, learnt: Captured) -> None:
    """Steps come some iterations later there, before the view is seen again."""
    with stubbed(Emulated()):
        ours = poses(end(spec).captured)
    assert np.abs(ours - poses(learnt)).max() < 0.5 * np.abs(poses(learnt) - before(spec)).max()


def test_districts_join_their_poses() -> None:
    pose = np.column_stack((np.eye(3), np.ones(3)))
    one = Captured(rows=np.array([0, 1]), poses=np.stack([pose, pose]), at_bound=np.array([False, True]))
    two = Captured(
        rows=np.array([1, 2]), poses=np.stack([pose + np.eye(3, 4, 3), pose]), at_bound=np.zeros(2, bool)
    )
    both = joined([one, two])
    assert both.at_bound is not None and both.at_bound.tolist() == [False, True, False]
    assert poses(both)[1, :, 3] == pytest.approx([1.5, 1, 1])
