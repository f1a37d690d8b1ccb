import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from panolog.renderer import ops
from panolog.renderer.motion import moved
from panolog.renderer.render import render_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.ply import write_ply
from panolog.workers.evaluation import EvaluateSpec, evaluate, evaluate_view
from panolog.workers.events import Evaluated, Event, LpipsMissing, Progress
from panolog.workers.specs import ModelFile, Source, Value
from panolog.workers.tasks import EVAL
from panolog.workers.training.initialise import scene_gaussians
from tests.on_device import view_on_device
from tests.workers.small import HEIGHT, WIDTH, small_scene

NO_LPIPS = "no lpips here"


@pytest.fixture(autouse=True)
def _no_lpips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("panolog.workers.evaluation.load_lpips", lambda _: (None, NO_LPIPS))


def run(folder: Path, model: Gaussians | Path | None = None) -> list[Event]:
    scene = small_scene(folder)
    if isinstance(model, Path):
        return list(evaluate(spec_of(scene, (4, 0), ModelFile(model))))
    return list(evaluate(spec_of(scene, (4, 0), Value(model or scene_gaussians(scene)))))


def spec_of(scene: Scene, views: tuple[int, ...], model: Source[Gaussians]) -> EvaluateSpec:
    return EvaluateSpec(scene=Value(scene), views=views, width=WIDTH, model=model, near=0.01)


def decode(png: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def test_each_view_has_its_metrics_and_its_render(tmp_path: Path) -> None:
    events = run(tmp_path)
    assert [type(event) for event in events] == [LpipsMissing, Evaluated, Progress, Evaluated, Progress]
    assert events[0] == LpipsMissing(EVAL, NO_LPIPS)
    first, last = events[1], events[-1]
    assert isinstance(first, Evaluated)
    assert isinstance(last, Progress)
    assert (first.view, last.iteration, last.iterations) == ("pano_4.png", 2, 2)
    assert first.metrics["lpips"] is None
    assert all(isinstance(first.metrics[key], float) for key in ("psnr", "ssim", "ws_psnr", "ws_ssim"))
    image = decode(first.png)
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert image.std() > 0


def test_a_ply_is_evaluated_as_its_gaussians_are(tmp_path: Path) -> None:
    gaussians = scene_gaussians(small_scene(tmp_path))
    write_ply(tmp_path / "model.ply", gaussians)
    first, again = run(tmp_path, tmp_path / "model.ply")[1], run(tmp_path)[1]
    assert isinstance(first, Evaluated)
    assert first == again


def test_the_mask_of_a_panorama_is_respected(tmp_path: Path) -> None:
    masked = run(tmp_path)[1]
    scene = small_scene(tmp_path, layers=False)
    plain = list(evaluate(spec_of(scene, (4,), Value(scene_gaussians(scene)))))[1]
    assert isinstance(masked, Evaluated)
    assert isinstance(plain, Evaluated)
    assert masked.png == plain.png
    assert masked.metrics["psnr"] != plain.metrics["psnr"]


def test_an_empty_model_renders_black(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    empty = scene_gaussians(scene).select(torch.zeros(200, dtype=torch.bool))
    event = list(evaluate(spec_of(scene, (4,), Value(empty))))[1]
    assert isinstance(event, Evaluated)
    assert not decode(event.png).any()


def test_a_view_on_a_device_is_measured_there(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    model, view = scene_gaussians(scene), load_view(scene.panoramas[4], 4, WIDTH)
    here = evaluate_view(model, scene.panoramas[4], view, WIDTH, 0.01)
    there = evaluate_view(model, scene.panoramas[4], view_on_device(view), WIDTH, 0.01)
    assert here[1] == there[1]
    assert all(there[0][key] == pytest.approx(value, abs=1e-5) for key, value in here[0].items())


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
    spec = replace(spec_of(scene, (4,), Value(model)), pose_fit=0.2)
    (event,) = (event for event in evaluate(spec) if isinstance(event, Evaluated))
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
    plain = list(evaluate(spec_of(scene, (4,), Value(model))))[1]
    assert isinstance(plain, Evaluated)
    assert (plain.metrics, plain.png, plain.pose_fit) == (event.metrics, event.png, None)


def test_a_pose_is_fitted_whatever_the_exposure_of_its_panorama(tmp_path: Path) -> None:
    (tmp_path / "bright").mkdir()
    event = fitted(*erring(tmp_path / "bright", gain=1.6))
    before, after = psnrs(event, "cc_psnr")
    assert before < 25 and after > 50  # 45 if the exposure is not found first


@contextmanager
def threads(count: int) -> Iterator[None]:
    ops.use_threads(count)
    try:
        yield
    finally:
        ops.use_threads(None)


def test_a_fit_has_the_same_bytes_for_any_threads(tmp_path: Path) -> None:
    scene, model = erring(tmp_path)
    with threads(1):
        one = fitted(scene, model)
    with threads(3):
        three = fitted(scene, model)
    assert one == three
