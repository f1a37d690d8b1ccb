"""`import panolog`: the names it offers, what importing them costs, and that they work on small data."""

import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import panolog
from panolog.workers.events import Checkpoint, Trained
from panolog.workers.tasks import Progress
from panolog.workers.training.initialise import scene_gaussians
from tests.scenes import HEIGHT, WIDTH, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


def config(iterations: int) -> panolog.RunConfig:
    return panolog.RunConfig.model_validate({"iterations": iterations, "sky": {"count": 20}, "device": "cpu"})


def test_the_names() -> None:
    """Which there are: the page of the API has each, by tests/structure."""
    assert set(panolog.__all__) <= set(dir(panolog))
    for name in set(panolog.__all__) - {"__version__"}:
        value = getattr(panolog, name)
        assert value.__name__ == name and value.__doc__
        assert inspect.isclass(value) == name[0].isupper()
        assert not name.endswith("Error") or issubclass(value, panolog.PanologError)
    assert panolog.__version__
    with pytest.raises(AttributeError, match="no attribute nonsense"):
        _ = panolog.nonsense


def write_model(folder: Path) -> Path:
    path = folder / "model.ply"
    panolog.write_ply(path, scene_gaussians(panolog.read_scene(write_scene(folder / "other"))))
    return path


def test_import_is_quick() -> None:
    script = (
        "import sys, panolog\n"
        "for name in 'RunConfig', 'Scene':\n"
        "    getattr(panolog, name)\n"
        "    loaded = {'torch', 'ray', 'cv2', 'matplotlib', 'pycolmap'} & set(sys.modules)\n"
        "    assert not loaded, (name, loaded)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_train_yields_events_and_resumes_from_a_checkpoint(scene: Path) -> None:
    events = list(panolog.train(str(scene), config(6)))
    assert isinstance(events[-1], Trained)
    assert any(isinstance(event, Progress) for event in events)
    *_, checkpoint = panolog.train(panolog.read_scene(scene), config(6), stop=lambda: True)
    assert isinstance(checkpoint, Checkpoint)
    *_, trained = panolog.train(scene, config(6), checkpoint=checkpoint)
    assert isinstance(trained, Trained)
    assert torch.equal(trained.gaussians.means, events[-1].gaussians.means)


def test_write_read_render_and_evaluate(scene: Path, tmp_path: Path) -> None:
    *_, trained = panolog.train(scene, config(2))
    assert isinstance(trained, Trained)
    path = str(tmp_path / "model.ply")
    panolog.write_ply(path, trained.gaussians)
    model = panolog.read_ply(path)
    assert (len(model), model.sky) == (len(trained.gaussians), 20)
    camera = panolog.Camera.of(np.eye(3), np.zeros(3), WIDTH, HEIGHT)
    assert panolog.render(model, camera).color.shape == (HEIGHT, WIDTH, 3)
    report = panolog.evaluate(path, str(scene), device="cpu")
    assert report == panolog.evaluate(model, panolog.read_scene(scene), device="cpu")
    read = panolog.read_scene(scene)
    assert list(report["views"]) == [read.panoramas[row].name for row in read.test]
    assert report["mean"]["psnr"] > 0


@pytest.mark.parametrize(("views", "says"), [([], "views: are none"), ([0, 99], "there is no row 99")])
def test_views_that_cannot_be_evaluated(views: list[int], says: str, scene: Path) -> None:
    """The mean of none was empty, and a row of no panorama an IndexError."""
    read = panolog.read_scene(scene)
    with pytest.raises(panolog.ConfigError, match=f"{says}.* to {len(read.panoramas) - 1}"):
        panolog.evaluate(panolog.initial_gaussians(read), read, views=views, device="cpu")


def test_run_and_resume_take_strings_and_the_defaults(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[object, ...]] = []
    monkeypatch.setattr("panolog.orchestrator.cli.session.session.start", lambda *given: calls.append(given))
    monkeypatch.setattr(
        "panolog.orchestrator.cli.session.session.resume", lambda *given, **_: calls.append(given)
    )
    output = str(tmp_path / "run")
    panolog.run(panolog.read_scene(scene), output)
    panolog.resume(output, address="auto")
    assert calls[0][:4] == (scene, Path(output), panolog.RunConfig(), None)
    panolog.run([str(scene), scene], output)
    assert calls.pop()[0] == [str(scene), scene]
    assert calls[1][:2] == (Path(output), "auto")


def test_errors_can_be_told_apart(tmp_path: Path, scene: Path) -> None:
    with pytest.raises(panolog.SceneError):
        panolog.read_scene(tmp_path / "none")
    with pytest.raises(panolog.DeviceError, match="--device tpu"):
        panolog.evaluate(panolog.read_ply(write_model(tmp_path)), scene, device="tpu")
