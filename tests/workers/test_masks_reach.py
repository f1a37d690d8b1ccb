"""Whatever lies under the masks changes nothing: alignment, sky, loss, scores and metrics.

In the photometric loss masked pixels count as equal to the photograph, and the window of SSIM reaches five
rows into the mask; what lies deeper has no say at all.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.scene.depth_alignment import Alignment, align_depth
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import load_layers
from panolog.scene.model import Scene
from panolog.workers.events import Evaluated
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import scene_gaussians
from tests.workers import trainings
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import coarse_of, evaluation_of, same, score_of, scored

IGNORED, SSIM_REACH = 12, 5  # rows
CONFIG = TrainConfig.model_validate({"sky": {"count": 40}, "depth": {"w0": 0.5, "wT": 0.4}})


def scene_in(folder: Path, noise: int) -> Scene:
    """A scene with the last IGNORED rows masked; with noise of that strength under the mask."""
    folder.mkdir()
    scene = small_scene(folder)
    random = np.random.default_rng(0)
    for panorama in scene.panoramas:
        assert panorama.mask and panorama.depth and panorama.sky_mask
        mask = cv2.imread(str(panorama.mask), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        mask[-IGNORED:] = 0
        cv2.imwrite(str(panorama.mask), mask)
        layers = {panorama.image: IGNORED - SSIM_REACH, panorama.depth: IGNORED, panorama.sky_mask: IGNORED}
        for path, rows in layers.items():
            layer = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert layer is not None
            layer[-rows:] = layer[-rows:] ^ random.integers(0, noise + 1, layer[-rows:].shape).astype(
                layer.dtype
            )
            cv2.imwrite(str(path), layer)
    return scene


@pytest.fixture
def clean(tmp_path: Path) -> Scene:
    return scene_in(tmp_path / "clean", 0)


@pytest.fixture
def spoilt(tmp_path: Path) -> Scene:
    return scene_in(tmp_path / "spoilt", 255)


def trained(scene: Scene) -> Gaussians:
    return trainings.trained(coarse_of(scene, CONFIG, iterations=8))


def without_masks(scene: Scene) -> Scene:
    return replace(scene, panoramas=tuple(replace(panorama, mask=None) for panorama in scene.panoramas))


def metrics(scene: Scene, model: Gaussians) -> dict[str, float | None]:
    events = evaluation_of(scene, model).run()
    return next(event.metrics for event in events if isinstance(event, Evaluated))


def test_alignment(clean: Scene, spoilt: Scene) -> None:
    def aligned(scene: Scene) -> Alignment:
        return align_depth(scene, load_layers(scene.panoramas[1], 1, WIDTH), 0)

    assert aligned(clean) == aligned(spoilt)
    assert aligned(clean).points < aligned(without_masks(clean)).points  # those under the mask are not used


def test_training(clean: Scene, spoilt: Scene) -> None:
    """Both losses and the colours of the sky."""
    assert same(trained(clean), trained(spoilt))
    assert not same(trained(without_masks(clean)), trained(without_masks(spoilt)))


def test_scores(clean: Scene, spoilt: Scene) -> None:
    def scores(scene: Scene) -> torch.Tensor:
        return scored(score_of(scene, scene_gaussians(scene), (0, 1)))

    assert torch.equal(scores(clean), scores(spoilt))
    assert not torch.equal(scores(without_masks(clean)), scores(without_masks(spoilt)))


def test_metrics(clean: Scene, spoilt: Scene) -> None:
    model = scene_gaussians(clean)
    assert metrics(clean, model) == metrics(spoilt, model)
    assert metrics(without_masks(clean), model) != metrics(without_masks(spoilt), model)
