"""What a run shows of its place before it trains: the points from a panorama, and as a model."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.orchestrator.engine.stages import first_look as module
from panolog.orchestrator.engine.stages.first_look import first_look, shown_row
from panolog.scene.errors import ImageError
from panolog.scene.files import here
from panolog.scene.model import Scene
from panolog.scene.projection import project_to_pixels
from panolog.workers.tasks import COARSE
from panolog.workers.training.optimizer import gaussians_of
from tests.workers.small import HEIGHT, WIDTH, small_scene
from tests.workers.test_sound_views import truncate

ROW = 4  # of the held-out panorama


@pytest.fixture
def divided(tmp_path: Path) -> Scene:
    """A scene with a panorama that is held out, and eight points around it, each with its grey."""
    scene = small_scene(tmp_path)
    center = scene.panoramas[ROW].center
    around = np.array([[x, y, z] for x in (-1, 1) for y in (-0.4, 0.4) for z in (-1, 1)], np.float64)
    colors = np.array([[60 + 25 * row] * 3 for row in range(8)], np.uint8)
    train = tuple(row for row in scene.train if row != ROW)
    return replace(scene, points=center + 3 * around, colors=colors, train=train, test=(ROW,))


def test_each_point_is_where_the_photograph_has_it(divided: Scene) -> None:
    look = first_look(divided, here)
    picture = cv2.imdecode(np.frombuffer(look.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (2 * HEIGHT, WIDTH, 3)
    _, v, u = project_to_pixels(divided.panoramas[ROW], divided.points, WIDTH, HEIGHT)
    seen = picture[v, u, ::-1].astype(np.float64)
    assert np.abs(seen - divided.colors).max() < 35  # nine tenths of it, and JPEG
    assert (look.task, look.iteration, look.held_out) == (COARSE, 0, True)
    assert look.view == divided.panoramas[ROW].name


def test_the_3d_view_gets_the_points(divided: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    saved = first_look(divided, here).snapshot
    assert saved is not None and saved.iteration == 0
    np.testing.assert_allclose(gaussians_of(saved.tensors).means.numpy(), divided.points, atol=1e-5)
    monkeypatch.setattr(module, "MOST", 3)
    few = first_look(divided, here).snapshot
    assert few is not None and len(gaussians_of(few.tensors)) == 3


def test_where_nothing_is_held_out_a_training_panorama_is_shown(divided: Scene) -> None:
    whole = replace(divided, train=(*divided.train, ROW), test=())
    look = first_look(whole, here)
    assert (look.view, look.held_out) == (whole.panoramas[whole.train[0]].name, False)
    assert shown_row(whole) is None


def test_a_panorama_that_cannot_be_decoded_is_an_error(divided: Scene) -> None:
    truncate(divided, ROW)
    with pytest.raises(ImageError):
        first_look(divided, here)
