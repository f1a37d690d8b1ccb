"""Each script in examples/ does on small data what its first lines say."""

import ast
import importlib.util
import os
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import panolog
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import SceneRef, make_info, write_info
from panolog.orchestrator.runs.records import Progressed, RunBegan
from panolog.prepare.importers import import_scene
from panolog.scene.image_files import read_info
from panolog.workers.tasks import COARSE
from panolog.workers.training.initialise import scene_gaussians
from tests.scenes import HEIGHT, WIDTH, write_image, write_scene

EXAMPLES = Path(__file__).parents[2] / "examples"
WHOLE_RUNS = Path(__file__).parents[1] / "orchestrator" / "whole_runs" / "test_whole_runs.py"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


def example(name: str) -> Callable[[list[str]], None]:
    """The `main` of a script."""
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    main: Callable[[list[str]], None] = module.main
    return main


def test_every_script_is_listed_and_tested() -> None:
    scripts = {path.stem for path in EXAMPLES.glob("*.py")}
    listed = (EXAMPLES / "README.md").read_text()
    tests = Path(__file__).read_text() + WHOLE_RUNS.read_text()  # there, one is compared with Ray
    for name in scripts:
        assert f"[{name}.py]({name}.py)" in listed
        assert f'example("{name}")' in tests


def test_scripts_use_public_names_alone() -> None:
    for path in EXAMPLES.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                assert not [it.name for it in node.names if it.name.startswith("panolog.")], path.name
            if isinstance(node, ast.ImportFrom):
                assert (node.module or "").split(".")[0] != "panolog", path.name
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "panolog":
                assert node.attr in panolog.__all__, (path.name, node.attr)


def test_the_training_loop_is_short() -> None:
    tree = ast.parse((EXAMPLES / "custom_training.py").read_text())
    train = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "train")
    assert train.end_lineno is not None and train.end_lineno - train.body[1].lineno < 25


def test_render_path(scene: Path, tmp_path: Path) -> None:
    model = tmp_path / "model.ply"
    panolog.write_ply(model, scene_gaussians(panolog.read_scene(scene)))
    example("render_path")([str(scene), str(model), str(tmp_path / "out"), "--frames", "3", "--width", "32"])
    images = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in images] == [f"frame_{number:05d}.png" for number in range(3)]
    assert {read_info(path).width for path in images} == {32}


def test_custom_training_learns(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, read = tmp_path / "model.ply", panolog.read_scene(scene)
    example("custom_training")([str(scene), str(model), "--iterations", "100", "--width", str(WIDTH)])
    assert "iteration 100: loss 0." in capsys.readouterr().out
    before, after = (
        panolog.evaluate(gaussians, read, views=read.train, device="cpu")["mean"]["psnr"]
        for gaussians in (scene_gaussians(read), panolog.read_ply(model))
    )
    assert after > before + 1


def test_add_importer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_scene, "FORMATS", dict(import_scene.FORMATS))
    random = np.random.default_rng(0)
    source = tmp_path / "source"
    lines = ["name,x,y,z,heading"]
    for number in range(6):
        write_image(source / "images" / f"{number}.png", random)
        lines.append(f"{number}.png,{number},0,1.5,90")
    (source / "poses.csv").write_text("\n".join(lines))
    points = [",".join(map(str, row)) for row in random.uniform(0, 9, (40, 6)).round(2)]
    (source / "points.csv").write_text("\n".join(["x,y,z,red,green,blue", *points]))
    example("add_importer")([str(source), str(tmp_path / "scene")])
    read = panolog.read_scene(tmp_path / "scene")
    assert (len(read.panoramas), len(read.points), read.height) == (6, 40, HEIGHT)
    assert np.allclose(read.centers[2], [2, 0, 1.5])
    assert np.allclose(read.panoramas[0].rotation[2], [1, 0, 0])  # looks east


def test_read_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    folder = RunFolder(tmp_path)
    write_info(folder, make_info(SceneRef(path="/scene", fingerprint="f"), RunConfig(width=64)))
    with closing(Database(folder.database)) as database:
        database.append([RunBegan("host", 1, resumed=False)])
        database.append([Progressed(COARSE, step, 20, 2.0, loss=1 / step) for step in (5, 10, 20)])
    example("read_run")([str(folder.root)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["/scene at 64 pixels: stopped", "coarse: waiting"]
    assert lines[-1] == "iteration 20: loss 0.0500"
