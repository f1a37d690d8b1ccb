"""Stage I with something in one of its pictures that is not of the place."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.workers.capture import movers
from panolog.workers.capture.captured import Captured, joined
from panolog.workers.events import Event
from panolog.workers.specs import Value
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.small import HEIGHT, WIDTH, small_scene
from tests.workers.trainings import checkpoints, coarse_of, content, end, settings

ROW, ROWS, COLUMNS = 2, slice(8, 20), slice(28, 40)  # where something black is
CONFIG = settings(
    sh={}, checkpoint={"every": 7}, exposure={"learn": True}, movers={"weigh": True, "factor": 1.2}
)


@pytest.fixture(scope="module", autouse=True)
def small_cells() -> Iterator[None]:
    """The grid has so few cells that one figure is a large part of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(movers, "_MOST", 0.5)
        yield


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> TrainSpec:
    scene = small_scene(tmp_path_factory.mktemp("scene"))
    path = str(scene.panoramas[ROW].image)
    picture = cv2.imread(path)
    assert picture is not None
    picture[ROWS, COLUMNS] = 0
    cv2.imwrite(path, picture)
    return coarse_of(scene, CONFIG, iterations=60)


@pytest.fixture(scope="module")
def events(spec: TrainSpec) -> list[Event]:
    return list(train(spec))


def movers_of(events: list[Event]) -> Captured:
    captured = end(events).captured
    assert captured is not None and captured.movers is not None
    return captured


def test_it_is_found_and_later_stages_leave_it_out(spec: TrainSpec, events: list[Event]) -> None:
    captured = movers_of(events)
    assert captured.movers is not None and captured.movers.shape == (4, HEIGHT // 4, WIDTH // 4)
    learnt: Scene = captured.applied(spec.scene.load())
    view = load_view(learnt.panoramas[ROW], ROW, WIDTH)
    assert view.mask is not None
    inside = view.mask[ROWS, COLUMNS].float().mean()
    assert float(inside) < 0.4
    assert view.mask[: HEIGHT - 4, 60:].all() and view.mask[: HEIGHT - 4, :4].all()
    held_out = load_view(learnt.panoramas[4], 4, WIDTH)
    before = load_view(spec.scene.load().panoramas[4], 4, WIDTH)
    assert held_out.mask is not None and before.mask is not None and torch.equal(held_out.mask, before.mask)


def test_the_setting_turns_it_off(spec: TrainSpec) -> None:
    off = settings(exposure={"learn": True}, movers={"weigh": False})
    captured = end(replace(spec, config=off, iterations=4)).captured
    assert captured is not None and captured.movers is None


def test_a_resumed_training_ends_with_the_same_bytes(spec: TrainSpec, events: list[Event]) -> None:
    saved = checkpoints(events)
    assert len(saved) == 8
    for checkpoint in (saved[1], saved[4], saved[7]):
        assert content(end(replace(spec, checkpoint=Value(checkpoint)))) == content(events[-1])


def test_no_number_of_threads_changes_the_bytes(spec: TrainSpec, events: list[Event]) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3 if before == 1 else 1)
    try:
        assert content(end(spec)) == content(events[-1])
    finally:
        torch.set_num_threads(before)


def test_districts_are_joined(events: list[Event]) -> None:
    captured = movers_of(events)
    assert captured.movers is not None
    first, second = (
        replace(captured, rows=captured.rows[at], movers=captured.movers[at], exposure=None)
        for at in (slice(0, 3), slice(1, 4))
    )
    both = joined([first, replace(second, movers=np.zeros_like(second.movers))])
    assert both.movers is not None and both.movers.dtype == np.bool_
    assert np.array_equal(both.movers[:3], captured.movers[:3]) and not both.movers[3].any()
