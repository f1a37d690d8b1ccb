"""`panolog scene`: what its commands print, how they end; nothing half-written stays."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import Result

from panolog.prepare.networks import depth_maps, masks
from panolog.prepare.networks.depth_maps import DepthJob
from panolog.prepare.sfm import pipeline
from panolog.prepare.sfm.joining import join
from panolog.scene.files import SUFFIX
from panolog.scene.read import read_scene
from tests.orchestrator.cli import program
from tests.orchestrator.cli.program import one_line, shown
from tests.prepare.importers.writers import nerfstudio, opensfm
from tests.prepare.networks.networks import given, red_depth
from tests.prepare.sfm.reports import faulty
from tests.scenes import HEIGHT, WIDTH, write_scene
from tests.workers.small import AFFINE

NAMES = [f"{index}.png" for index in range(4)]
MANIFEST = {
    "task": "depth",
    "input": given(HEIGHT),
    "depth": {"output": "depth", "kind": "inverse", "distance": "radial", "factor": 2.0},
    "sky": {"output": "sky", "threshold": 0.99, "above": "sky"},
}


def call(*arguments: object) -> Result:
    return program.call("scene", *arguments)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Panoramas whose red is, through an affine, the inverse distance of the sparse points on it."""
    root = write_scene(tmp_path / "scene", names=NAMES, points=400)
    read = read_scene(root)
    for panorama in read.panoramas:
        local = read.points[panorama.observed] @ panorama.rotation.T + panorama.translation
        distance = np.linalg.norm(local, axis=1)
        u = ((np.arctan2(local[:, 0], local[:, 2]) / (2 * np.pi) + 0.5) * WIDTH).astype(int) % WIDTH
        v = ((np.arcsin(local[:, 1] / distance) / np.pi + 0.5) * HEIGHT).astype(int)
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[..., 2] = 20
        image[v, u, 2] = np.clip(255 * (1 / distance - AFFINE[1]) / AFFINE[0], 1, 255)
        cv2.imwrite(str(panorama.image), image)
    return root


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return red_depth(tmp_path, MANIFEST)


def test_depth_prints_the_table_and_goes_on_where_it_was(scene: Path, model: Path) -> None:
    first = call("depth", scene, "--model", model, "--json")
    assert first.exit_code == 0, first.output
    shown = json.loads(first.stdout)
    counts = {"made": 4, "kept": 0, "given": 0, "maps": 4, "aligned": 4, "device": "cpu"}
    assert {name: shown[name] for name in counts} == counts
    for image in shown["images"]:
        assert image["points"] > 100 and image["inliers"] > 0.5 * image["points"]
        # red / 255 = inverse metres / 2, and 65535 of a map is 4 inverse metres
        assert image["scale"] == pytest.approx(AFFINE[0] * 2 * 4, rel=0.1)
        assert image["offset"] == pytest.approx(AFFINE[1], abs=0.02)
    assert shown["metres_per_unit"] == pytest.approx(shown["scale"] / 4)
    again = call("depth", scene, "--model", model)
    assert again.exit_code == 0
    assert "0 maps made, 4 kept, 0 given" in again.stdout and "3.png: scale" in again.stdout
    assert "0 panoramas on cpu; 4 are done" in again.stderr


def test_an_image_that_cannot_be_aligned_is_named(scene: Path, model: Path) -> None:
    path = scene / "images" / NAMES[2]
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    shown = json.loads(call("depth", scene, "--model", model, "--json").stdout)
    assert shown["aligned"] == 3
    assert "the same at all sparse points" in shown["images"][2]["reason"]


def test_ctrl_c_keeps_what_is_done(scene: Path, model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = depth_maps.make_depth

    def stopped(job: DepthJob, batch: int, progress: object) -> None:
        def interrupt(done: int, total: int) -> None:
            raise KeyboardInterrupt

        real(job, batch, interrupt)

    monkeypatch.setattr("panolog.prepare.networks.depth_report.make_depth", stopped)
    result = call("depth", scene, "--model", model)
    assert result.exit_code == 130
    assert "finished work is kept; the same command resumes it" in result.stderr
    assert not list(scene.rglob(f"*{SUFFIX}"))
    monkeypatch.undo()
    assert "3 maps made, 1 kept" in call("depth", scene, "--model", model).stdout


def test_wrong_input_is_one_line_and_leaves_nothing(scene: Path, model: Path, tmp_path: Path) -> None:
    before = sorted(scene.rglob("*"))
    assert "there is no such model" in one_line(call("depth", scene, "--model", tmp_path / "no.onnx"))
    assert "there is no such folder" in one_line(call("depth", tmp_path / "no", "--model", model))
    assert "--device tpu: choose auto" in one_line(call("depth", scene, "--model", model, "--device", "tpu"))
    assert "no COLMAP model" in one_line(call("depth", model.parent, "--model", model))
    model.with_suffix(".yaml").write_text("task: depth")
    assert "net.yaml: input: it is missing" in one_line(call("depth", scene, "--model", model))
    assert "nothing to mask" in one_line(call("mask", scene))
    assert "--nadir 91: " in one_line(call("mask", scene, "--nadir", 91))
    assert "--nadir nan: " in one_line(call("mask", scene, "--nadir", "nan"))
    assert "4 panoramas are too few" in one_line(call("mask", scene, "--static"))
    assert "net.yaml: task: " in one_line(call("mask", scene, "--model", model))
    assert sorted(scene.rglob("*")) == before


def test_masks_are_counted(scene: Path) -> None:
    shown = json.loads(call("mask", scene, "--nadir", 60, "--json").stdout)
    assert (shown["made"], shown["kept"], shown["static"]) == (4, 0, None)
    assert shown["images"][0]["ignored"] == pytest.approx(0.25, abs=0.02)  # of 32 rows
    again = call("mask", scene, "--nadir", 60)
    assert "0 masks made, 4 were there" in again.stdout
    assert f"{NAMES[1]}: {shown['images'][1]['ignored']:.1%} of the sphere is ignored" in again.stdout


def test_a_mask_that_is_not_2_to_1_is_named(scene: Path) -> None:
    (scene / "masks").mkdir()
    cv2.imwrite(str(scene / "masks" / NAMES[3]), np.zeros((9, 9), np.uint8))
    result = call("mask", scene, "--nadir", 20)
    assert result.exit_code == 2
    assert "masks/3.png: 9 x 9 pixels are not 2:1" in result.stderr
    assert not (scene / masks.GIVEN).exists()


def test_a_black_nadir_is_found_and_masked(scene: Path) -> None:
    assert "--nadir auto: the panoramas are not black" in one_line(call("mask", scene, "--nadir", "auto"))
    for name in NAMES:
        path = scene / "images" / name
        picture = np.asarray(cv2.imread(str(path)))
        picture[picture.shape[0] * 3 // 4 :] = 0
        cv2.imwrite(str(path), picture)
    assert "--nadir auto` masks that" in call("check", scene).stdout
    result = call("mask", scene, "--nadir", "auto")
    assert result.exit_code == 0
    assert "degrees of straight down is ignored" in result.stdout
    assert "--nadir auto" not in call("check", scene).stdout


def test_what_masks_ignore_and_files_that_match_nothing_are_shown(scene: Path) -> None:
    """Inverted masks, masks of nothing and masks of other names trained without a word."""
    folder = scene / "masks"
    folder.mkdir()
    assert "masks:" not in call("info", scene).stdout.replace("layers: 0 masks", "")
    mask = np.zeros((32, 64), np.uint8)
    mask[24:] = 255
    for name in NAMES[:2]:
        cv2.imwrite(str(folder / name), mask)
    for name in NAMES[2:]:
        cv2.imwrite(str(folder / f"other_{name}"), mask)
    shown = json.loads(call("info", scene, "--json").stdout)["layers"]
    assert shown[0].startswith(
        "masks: 2 of 4 panoramas have one, and 85.4% of the sphere is ignored (85.4% to"
    )
    assert shown[0].endswith(
        "that is most of it: black or transparent is what is ignored, invert them if it is to be used"
    )
    lost = ", ".join(f"other_{name}" for name in NAMES[2:])
    assert shown[1] == f"masks: 2 files ({lost}): not used, as no panorama of the model is called so"
    assert shown[0] in call("info", scene).stdout
    cv2.imwrite(str(folder / NAMES[0]), np.zeros((32, 64), np.uint8))
    assert f"masks: nothing is left of 1 panorama ({NAMES[0]})" in call("check", scene).stdout
    cv2.imwrite(str(folder / NAMES[1]), np.zeros((32, 64), np.uint8))
    *_, problem = json.loads(call("check", scene, "--json").stdout)["problems"]
    assert problem.startswith("masks: nothing is left of 2 panoramas that were looked at")
    for name in NAMES[:2]:
        cv2.imwrite(str(folder / name), np.full((32, 64), 255, np.uint8))
    assert "nothing is: black or transparent is what is ignored" in call("info", scene).stdout


def test_import(tmp_path: Path) -> None:
    _, source = opensfm(tmp_path / "source")
    result = call("import", source.path, "-o", tmp_path / "scene")
    assert result.exit_code == 0, result.output
    assert "6 panoramas, 40 points" in result.stdout
    assert "smaller reconstructions are left out" in result.stderr
    assert call("info", tmp_path / "scene").exit_code == 0


def test_import_as_json(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    arguments = ("-o", tmp_path / "scene", "--link", "--format", "nerfstudio")
    report = shown("scene", "import", source.path / "transforms.json", *arguments)
    assert (report["format"], report["panoramas"], report["points"]) == ("nerfstudio", 6, 40)
    assert (tmp_path / "scene" / "images" / "pano_00.png").is_symlink()
    # The pictures of the small scene are noise: said in one line, and by the exit code.
    result = call("check", tmp_path / "scene")
    assert result.exit_code == 2
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("WRONG")]
    assert "points and pixels hardly correlate" in line
    assert result.stdout.splitlines()[-1] == "verdict: a problem; fix that first, or training yields fog"
    found = call("check", tmp_path / "scene", "--json")
    assert found.exit_code == 2
    assert len(json.loads(found.stdout)["problems"]) == 1


@pytest.mark.parametrize("option", [(), ("--format", "colmapper"), ("--images", "nowhere")])
def test_wrong_imports_are_one_line(option: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert one_line(call("import", tmp_path / "empty", "-o", tmp_path / "scene", *option))
    assert not (tmp_path / "scene").exists()
    assert call("check", tmp_path / "scene").exit_code == 2


def test_options_reach_the_job_and_its_report_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[Any, ...]] = []
    report = faulty()

    def make_scene(*arguments: Any, memory: int) -> object:
        assert memory > 0
        given.append(arguments[:3])
        return report

    monkeypatch.setattr(pipeline, "make_scene", make_scene)
    output = tmp_path / "scene"
    result = call("sfm", "images", "-o", output, "--json", "--partial", "--pairs", "exhaustive")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"scene": str(output), **report.as_json()}
    wanted = pipeline.SfmSettings(partial=True, parts=True, pairing="exhaustive")
    assert given == [(Path("images"), output, wanted)]
    result = call("sfm", "images", "-o", output)
    assert result.exit_code == 0
    assert result.stdout.splitlines()[: len(list(report.lines()))] == list(report.lines())


def test_panoramas_are_added_to_a_scene_into_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[Any, ...]] = []

    def join_scene(*arguments: Any, memory: int) -> object:
        assert memory > 0
        given.append(arguments[:4])
        return faulty()

    monkeypatch.setattr(join, "join_scene", join_scene)
    output = tmp_path / "both"
    result = call("sfm", "a", "b", "--into", "scene", "-o", output, "--link", "--json")
    assert result.exit_code == 0, result.output
    wanted = pipeline.SfmSettings(link=True)
    assert given == [([Path("a"), Path("b")], Path("scene"), output, wanted)]
    assert json.loads(result.stdout)["scene"] == str(output)
    assert call("sfm", "a", "--into", "scene").exit_code == 2  # the scene itself never changes


def test_what_cannot_be_done_is_one_line(tmp_path: Path) -> None:
    output = tmp_path / "scene"
    assert one_line(call("sfm", tmp_path / "nothing", "-o", output))
    assert call("sfm", tmp_path, "-o", output, "--mapper", "magic").exit_code == 2
    assert not output.exists()
