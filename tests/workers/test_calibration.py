from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.renderer import ops
from panolog.scene.errors import InputError
from panolog.scene.model import Scene
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.events import Calibration
from panolog.workers.specs import Value
from panolog.workers.training.config import DensifyConfig, SkyConfig, TrainConfig
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import threads


def calibrated(folder: Path, *, most: int = 1_000, seconds: float = 10.0, **densify: float) -> Calibration:
    config = TrainConfig(sky=SkyConfig(count=50), densify=DensifyConfig.model_validate(densify))
    *_, found = spec_of(small_scene(folder), config=config, seconds=seconds, most=most).run()
    assert isinstance(found, Calibration)
    return found


def spec_of(scene: Scene, **fields: Any) -> CalibrateSpec:
    given: dict[str, Any] = {"config": TrainConfig(), "seconds": 1.0, "most": 1_000} | fields
    return CalibrateSpec(scene=Value(scene), width=WIDTH, iterations=300, seed=0, **given)


@pytest.mark.parametrize("count", [1, 2])
def test_two_models_are_measured_with_the_threads_that_there_are(tmp_path: Path, count: int) -> None:
    with threads(count):
        found = calibrated(tmp_path)
        assert found.threads == count == ops.threads()
    assert found.initial.gaussians == 250
    assert found.grown.gaussians > 400
    assert 0 < found.share <= 1
    for sample in (found.initial, found.grown):
        assert sample.seconds > 0
        assert sample.host > 50 * 2**20  # the process itself
        assert sample.device == 0
    assert min(found.begin, found.decode, found.single, found.look) > 0
    assert found.images == 4 * 9 * WIDTH * WIDTH // 2


def test_the_second_model_is_no_larger_than_allowed(tmp_path: Path) -> None:
    assert calibrated(tmp_path, most=300).grown.gaussians == 300


def test_where_nothing_would_grow_nothing_does(tmp_path: Path) -> None:
    found = calibrated(tmp_path, gradient=1e9)
    assert found.share == 0
    assert found.grown.gaussians == found.initial.gaussians


def test_growth_does_not_depend_on_who_would_densify(tmp_path: Path) -> None:
    """Opaque ones, or those with large absolute gradients: here none."""
    assert calibrated(tmp_path, least_opacity=0.9, split_gradient=1e9).grown.gaussians > 400


def test_without_time_each_model_still_has_an_iteration(tmp_path: Path) -> None:
    found = calibrated(tmp_path, seconds=0.0)
    assert found.initial.seconds > 0
    assert found.grown.seconds > 0


def test_masks_that_leave_nothing_are_refused_before_anything_is_trained(tmp_path: Path) -> None:
    """A run used to train on nothing, to a model without metrics."""
    scene = small_scene(tmp_path)
    for row in scene.train:
        mask = scene.panoramas[row].mask
        assert mask is not None
        cv2.imwrite(str(mask), np.zeros((WIDTH // 2, WIDTH), np.uint8))
    with pytest.raises(InputError, match="the masks leave nothing of 4 panoramas"):
        list(spec_of(scene).run())
