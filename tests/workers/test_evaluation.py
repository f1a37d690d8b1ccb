from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

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
