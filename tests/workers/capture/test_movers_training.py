"""Stage I with something in one of its pictures that is not of the place."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.workers.capture import movers
from panolog.workers.capture.captured import Captured, joined
from panolog.workers.events import Checkpoint, Event, Trained
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.small import HEIGHT, WIDTH, small_scene

ROW, ROWS, COLUMNS = 2, slice(8, 20), slice(28, 40)  # where something black is
CONFIG = TrainConfig.model_validate(
    {
        "sky": {"count": 60},
        "densify": {"every_floor": 4, "start": 0, "gradient": 1e-6, "max_gaussians": 260},
        "reset": {"every_floor": 9, "opacity": 0.05},
        "checkpoint": {"every": 7, "share": 1},
        "exposure": {"learn": True},
        "movers": {"weigh": True, "factor": 1.2},
    }
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
    return TrainSpec(
        task=COARSE, scene=Value(scene), views=scene.train, width=WIDTH, iterations=60, config=CONFIG, seed=3
    )


@pytest.fixture(scope="module")
def events(spec: TrainSpec) -> list[Event]:
    return list(train(spec))


def result(events: list[Event]) -> tuple[bytes, ...]:
    """All bytes that a task ends with."""
    last = events[-1]
    assert isinstance(last, Trained) and last.captured is not None
    captured = last.captured
    assert captured.movers is not None and captured.exposure is not None
    learnt = captured.rows.tobytes(), captured.movers.tobytes(), captured.exposure.tobytes()
    return *(tensor.numpy().tobytes() for tensor in last.gaussians.tensors().values()), *learnt


def movers_of(events: list[Event]) -> Captured:
    last = events[-1]
    assert isinstance(last, Trained) and last.captured is not None and last.captured.movers is not None
    return last.captured


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
    off = CONFIG.movers.model_copy(update={"weigh": False})
    *_, last = train(replace(spec, config=CONFIG.model_copy(update={"movers": off}), iterations=4))
    assert isinstance(last, Trained) and last.captured is not None and last.captured.movers is None


def test_a_resumed_training_ends_with_the_same_bytes(spec: TrainSpec, events: list[Event]) -> None:
    saved = [event for event in events if isinstance(event, Checkpoint)]
    assert len(saved) == 8
    for checkpoint in (saved[1], saved[4], saved[7]):
        assert result(list(train(replace(spec, checkpoint=Value(checkpoint))))) == result(events)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
def test_no_number_of_threads_changes_the_bytes(spec: TrainSpec, events: list[Event]) -> None:
    for count in (1, 3):
        torch.set_num_threads(count)
        assert result(list(train(spec))) == result(events)


def test_it_survives_its_file_and_districts_are_joined(tmp_path: Path, events: list[Event]) -> None:
    captured = movers_of(events)
    captured.save(tmp_path / "captured.npz")
    loaded = Captured.load(tmp_path / "captured.npz")
    assert loaded.movers is not None and captured.movers is not None
    assert np.array_equal(loaded.movers, captured.movers) and loaded.movers.dtype == np.bool_
    first, second = (
        replace(captured, rows=captured.rows[at], movers=captured.movers[at], exposure=None)
        for at in (slice(0, 3), slice(1, 4))
    )
    both = joined([first, replace(second, movers=np.zeros_like(second.movers))])
    assert both.movers is not None and both.movers.dtype == np.bool_
    assert np.array_equal(both.movers[:3], captured.movers[:3]) and not both.movers[3].any()
