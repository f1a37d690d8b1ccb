"""Trainings that refine poses: the same bytes after a stop and for any threads, on a card as on the CPU."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from panolog.renderer import ops
from panolog.scene.gaussians import Gaussians
from panolog.workers.capture.captured import Captured, joined
from panolog.workers.capture.config import PosesConfig
from panolog.workers.events import Checkpoint, Event, Trained
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.trainer import TrainSpec, train
from tests.renderer.cuda.stubbed import stubbed
from tests.workers.small import WIDTH, small_scene
from tests.workers.training.test_pipeline import Emulated

SETTINGS = {
    "sky": {"count": 20},
    "densify": {"until": 0},
    "checkpoint": {"every": 4, "share": 1},
    "poses": {"refine": True, "begin": 0.1, "visits": 0},
}


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> TrainSpec:
    scene = small_scene(tmp_path_factory.mktemp("scene"), points=60)
    return TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=WIDTH // 2,
        iterations=14,
        config=TrainConfig.model_validate(SETTINGS),
        seed=3,
    )


def learnt(events: Sequence[Event]) -> tuple[Gaussians, Captured]:
    last = events[-1]
    assert isinstance(last, Trained) and last.captured is not None
    return last.gaussians, last.captured


def poses(captured: Captured) -> np.ndarray:
    assert captured.poses is not None
    return captured.poses


def same(one: Sequence[Event], two: Sequence[Event]) -> bool:
    (model, captured), (other, found) = learnt(one), learnt(two)
    tensors = other.tensors()
    alike = all(torch.equal(tensor, tensors[name]) for name, tensor in model.tensors().items())
    return alike and poses(captured).tobytes() == poses(found).tobytes()


@pytest.fixture(scope="module")
def events(spec: TrainSpec) -> list[Event]:
    return list(train(spec))


def test_cameras_move(spec: TrainSpec, events: list[Event]) -> None:
    scene, (_, captured) = spec.scene.load(), learnt(events)
    before = np.stack([np.column_stack((p.rotation, p.translation)) for p in scene.panoramas])[captured.rows]
    assert captured.rows.tolist() == sorted(spec.views)
    assert 1e-5 < np.abs(poses(captured) - before).max() < 0.1
    turned = poses(captured)[:, :, :3]
    assert np.einsum("nij,nkj->nik", turned, turned) == pytest.approx(np.tile(np.eye(3), (len(turned), 1, 1)))


def test_a_resumed_training_ends_with_the_same_bytes(spec: TrainSpec, events: list[Event]) -> None:
    saved = [event for event in events if isinstance(event, Checkpoint)]
    assert len(saved) >= 2
    for checkpoint in saved[:2]:
        assert same(events, list(train(replace(spec, checkpoint=Value(checkpoint)))))


def test_the_number_of_threads_changes_nothing(spec: TrainSpec, events: list[Event]) -> None:
    ops.use_threads(3)
    try:
        assert same(events, list(train(spec)))
    finally:
        ops.use_threads(None)


def test_poses_that_stay_are_not_captured(spec: TrainSpec) -> None:
    still = spec.config.model_copy(update={"poses": PosesConfig(refine=False)})
    last = list(train(replace(spec, config=still)))[-1]
    assert isinstance(last, Trained) and last.captured is None


@pytest.mark.system
def test_a_card_learns_as_the_cpu(spec: TrainSpec, events: list[Event]) -> None:
    """Steps come some iterations later there, before the view is seen again."""
    with stubbed(Emulated()):
        ours = poses(learnt(list(train(spec)))[1])
    theirs, scene = poses(learnt(events)[1]), spec.scene.load()
    before = np.stack([np.column_stack((p.rotation, p.translation)) for p in scene.panoramas])[
        list(spec.views)
    ]
    assert np.abs(ours - theirs).max() < 0.5 * np.abs(theirs - before).max()


def test_districts_join_their_poses() -> None:
    pose = np.column_stack((np.eye(3), np.ones(3)))
    one = Captured(rows=np.array([0, 1]), poses=np.stack([pose, pose]), at_bound=np.array([False, True]))
    two = Captured(
        rows=np.array([1, 2]), poses=np.stack([pose + np.eye(3, 4, 3), pose]), at_bound=np.zeros(2, bool)
    )
    both = joined([one, two])
    assert both.at_bound is not None and both.at_bound.tolist() == [False, True, False]
    assert poses(both)[1, :, 3] == pytest.approx([1.5, 1, 1])
