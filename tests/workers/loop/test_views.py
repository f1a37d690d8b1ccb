"""Views for a training loop: their order is that of `panolog.train`, and depth is aligned."""

from pathlib import Path

import pytest
import torch

from panolog.renderer.camera import Camera
from panolog.scene.errors import ConfigError, DeviceError
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.loop.views import initial_gaussians, load_views
from panolog.workers.training.config import DepthConfig
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.loss import DepthTargets
from panolog.workers.training.schedule import order
from tests.scenes import write_scene
from tests.workers.small import small_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return read_scene(write_scene(tmp_path_factory.mktemp("scene")))


def test_the_order_is_that_of_the_trainer_with_each_view_once_an_epoch(scene: Scene) -> None:
    count = 2 * len(scene.train) + 3
    rows = [view.row for view in load_views(scene, 32, count)]
    assert rows == [next(order(0, "coarse", scene.train, iteration)) for iteration in range(1, count + 1)]
    assert sorted(rows[: len(scene.train)]) == sorted(scene.train)
    assert rows != [view.row for view in load_views(scene, 32, count, seed=1)]


def test_a_view_has_its_camera_and_its_picture(scene: Scene) -> None:
    (view,) = load_views(scene, 32, 1, rows=[scene.test[0]])
    panorama = scene.panoramas[scene.test[0]]
    assert (view.name, view.row) == (panorama.name, scene.test[0])
    assert (view.image.shape, view.image.dtype) == ((16, 32, 3), torch.uint8)
    expected = Camera.at(panorama, 32)
    assert torch.equal(view.camera.rotation, expected.rotation)
    assert torch.equal(view.camera.translation, expected.translation)
    assert (view.camera.width, view.camera.height) == (32, 16)
    assert view.depth is None


def test_a_width_or_device_that_there_is_not_is_an_error(scene: Scene) -> None:
    with pytest.raises(ConfigError, match="width 65"):
        next(load_views(scene, 65, 1))
    with pytest.raises(DeviceError, match="tpu"):
        next(load_views(scene, 64, 1, device="tpu"))
    with pytest.raises(ConfigError, match="rows: are none"):
        next(load_views(scene, 64, 1, rows=[]))
    for row in (-1, len(scene.panoramas)):
        with pytest.raises(ConfigError, match=f"rows: there is no row {row} of scene.panoramas, only 0 to"):
            next(load_views(scene, 64, 1, rows=[0, row]))


def test_the_first_model_has_points_then_a_sky(scene: Scene) -> None:
    model = initial_gaussians(scene, sky=40)
    assert (len(model), model.sky) == (len(scene.points) + 40, 40)
    assert torch.equal(model.means[:-40], scene_gaussians(scene).means)
    assert initial_gaussians(scene).sky == 0


def test_depth_is_the_target_of_the_trainer(tmp_path: Path) -> None:
    place = small_scene(tmp_path)
    (view,) = load_views(place, 64, 1, depth=True)
    found = DepthTargets(place, DepthConfig(), 0).target(load_view(place.panoramas[view.row], view.row, 64))
    assert view.depth is not None and found is not None
    assert torch.equal(view.depth[0], found[0]) and torch.equal(view.depth[1], found[1])
    assert view.depth[1].any()
