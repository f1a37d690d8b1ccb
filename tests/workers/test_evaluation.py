import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.renderer.motion import moved
from panolog.renderer.render import render_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.workers.events import Evaluated, LpipsMissing
from panolog.workers.tasks import EVAL, Progress
from panolog.workers.training.initialise import scene_gaussians
from tests.workers.small import HEIGHT, WIDTH, small_scene
from tests.workers.trainings import evaluation_of


def test_each_view_has_its_metrics_and_its_render(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("panolog.workers.evaluation.load_lpips", lambda _: (None, "no lpips here"))
    events = list(evaluation_of(scene, scene_gaussians(scene), (4, 0)).run())
    assert [type(event) for event in events] == [LpipsMissing, Evaluated, Progress, Evaluated, Progress]
    assert events[0] == LpipsMissing(EVAL, "no lpips here")
    first, last = events[1], events[-1]
    assert isinstance(first, Evaluated)
    assert isinstance(last, Progress)
    assert (first.view, last.iteration, last.iterations) == ("pano_4.png", 2, 2)
    assert first.metrics["lpips"] is None
    assert all(isinstance(first.metrics[key], float) for key in ("psnr", "ssim", "ws_psnr", "ws_ssim"))
    image = cv2.imdecode(np.frombuffer(first.png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and image.shape == (HEIGHT, WIDTH, 3)
    assert image.std() > 0


PIXEL = 2 * np.pi / WIDTH  # radians


def erring(folder: Path, gain: float = 1.0) -> tuple[Scene, Gaussians]:
    """A scene whose pose of panorama 4 is off by two pixels, what it shows, and a model that is right.

    Args: gain, by which the panorama is brighter than the model, in linear light.
    """
    scene = small_scene(folder, points=3000)
    model, right = scene_gaussians(scene), scene.panoramas[4]
    shown = render_bytes(model, right.rotation, right.translation, WIDTH, 0.01).numpy() / 255
    factor = gain ** (1 / 2.4)
    shown = np.clip(shown * factor + 0.055 * (factor - 1), 0, 1) * 255
    cv2.imwrite(str(right.image), shown[..., ::-1].round().astype(np.uint8))
    wrong = moved(right.rotation, right.translation, np.array([0, 0.0, 0, 0.5, 2.0, -0.4]) * PIXEL)
    panoramas = list(scene.panoramas)
    panoramas[4] = replace(right, rotation=wrong[0], translation=wrong[1])
    if gain != 1:
        panoramas[0] = replace(panoramas[0], exposure=np.zeros((2, 3)))
    return replace(scene, panoramas=tuple(panoramas)), model


def fitted(scene: Scene, model: Gaussians) -> Evaluated:
    spec = evaluation_of(scene, model, pose_fit=0.2)
    (event,) = (event for event in spec.run() if isinstance(event, Evaluated))
    return event


def psnrs(event: Evaluated, name: str = "psnr") -> tuple[float, float]:
    assert event.pose_fit is not None
    before, after = event.metrics[name], event.pose_fit[name]
    assert before is not None and after is not None
    return before, after


def test_a_pose_that_errs_is_fitted_and_measured_beside_its_own(tmp_path: Path) -> None:
    scene, model = erring(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        event = fitted(scene, model)
    before, after = psnrs(event)
    assert after > before + 8
    assert event.pose_fit is not None and event.pose_fit["pixels"] == pytest.approx(2.1, abs=0.6)
    plain = next(evaluation_of(scene, model).run())
    assert isinstance(plain, Evaluated)
    assert (plain.metrics, plain.png, plain.pose_fit) == (event.metrics, event.png, None)


def test_a_pose_is_fitted_whatever_the_exposure_of_its_panorama(tmp_path: Path) -> None:
    (tmp_path / "bright").mkdir()
    event = fitted(*erring(tmp_path / "bright", gain=1.6))
    before, after = psnrs(event, "cc_psnr")
    assert before < 25 and after > 50  # 45 if the exposure is not found first
