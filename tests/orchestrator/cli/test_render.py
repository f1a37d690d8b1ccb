"""`panolog render`: the size of perspective views, and videos."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import Result

from panolog.export.splats import ModelSource
from panolog.orchestrator.cli.commands.render import lens_like
from panolog.renderer.camera import Lens
from panolog.scene.ply import write_ply
from panolog.scene.read import read_scene
from panolog.workers.training.initialise import scene_gaussians
from tests.export.sog.models import write_unpacked
from tests.orchestrator.cli.program import call, one_line

FRAMES = 4


@pytest.fixture
def ply(scene: Path, tmp_path: Path) -> Path:
    path = tmp_path / "model.ply"
    write_ply(path, scene_gaussians(read_scene(scene)))
    return path


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    """Steps along x."""
    path = tmp_path / "poses.json"
    rows = [[[1, 0, 0, i / 10], [0, 1, 0, 0], [0, 0, 1, 0]] for i in range(FRAMES)]
    path.write_text(json.dumps([{"camera_to_world": matrix} for matrix in rows]))
    return path


def render(*arguments: object) -> Result:
    return call("render", *arguments)


@pytest.mark.parametrize(
    ("panorama", "fov", "size"),
    [
        (4096, 90, (1304, 734)),  # 4096 / π · tan 45° pixels
        (512, 90, (640, 360)),  # at least
        (8192, 150, (3840, 2160)),  # at most
        (4096, 1e-9, (640, 360)),
    ],
)
def test_a_view_is_as_fine_in_its_middle_as_the_panoramas(
    panorama: int, fov: float, size: tuple[int, int]
) -> None:
    assert lens_like(panorama, fov) == Lens(*size, fov)


@pytest.mark.parametrize(
    ("fov", "size", "blurred"), [(2, "160x2", True), (2, "100x2", False), (170, "64x32", False)]
)
def test_a_view_that_no_panorama_is_as_fine_as_is_said_to_be_blurred(
    ply: Path,
    poses: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fov: int,
    size: str,
    blurred: bool,
) -> None:
    small = np.zeros((8, 16, 3), np.uint8)
    monkeypatch.setattr("panolog.orchestrator.cli.commands.render.render_panorama", lambda *_: small)
    done = render(ply, "-o", tmp_path / "out", "--poses", poses, "--fov", fov, "--size", size)
    assert done.exit_code == 0
    assert ("a view of 92 pixels has the same detail" in done.stderr) == blurred


def test_a_video_of_perspective_views(ply: Path, poses: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = render(ply, "-o", out, "--poses", poses, "--fov", 90, "--size", "64x36", "--mp4", "--fps", 12)
    assert (done.exit_code, done.stderr) == (0, f"{out / 'video.mp4'}\n"), done.output
    assert [path.name for path in out.iterdir()] == ["video.mp4"]
    video = cv2.VideoCapture(str(out / "video.mp4"))
    assert [video.read()[1].shape for _ in range(FRAMES)] == [(36, 64, 3)] * FRAMES
    assert not video.read()[0]
    assert video.get(cv2.CAP_PROP_FPS) == 12


def test_a_video_that_is_cut_off_leaves_nothing(
    ply: Path, poses: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("panolog.orchestrator.cli.commands.render.perspective", interrupt)
    out = tmp_path / "out"
    assert render(ply, "-o", out, "--poses", poses, "--fov", 90, "--size", "64x36", "--mp4").exit_code == 130
    assert list(out.iterdir()) == []


def test_a_video_whose_end_is_missing_is_none(
    ply: Path, poses: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk OpenCV wrote what fitted, and said nothing."""

    class Full:
        fourcc, real = cv2.VideoWriter.fourcc, cv2.VideoWriter

        def __init__(self, name: str, *arguments: Any) -> None:
            self.name, self.writer = name, self.real(name, *arguments)
            self.isOpened, self.write = self.writer.isOpened, self.writer.write

        def release(self) -> None:
            self.writer.release()
            os.truncate(self.name, 600)

    monkeypatch.setattr(cv2, "VideoWriter", Full)
    done = render(ply, "-o", tmp_path / "out", "--poses", poses, "--width", 64, "--mp4")
    assert done.exit_code == 1 and "is the disk full?" in done.stderr
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--path", "3", "--width", "33"), "must be even"),
        (("--poses", "poses.json", "--mp4", "--fov", "90", "--size", "64x35"), "both must be even"),
        (("--poses", "poses.json", "--mp4", "--width", "66"), "both must be even"),
        (("--fov", "90", "--size", "big"), "like 1280x720"),
        (("--fov", "90", "--size", "40000x20"), "at most 32766"),
        (("--fov", "200"), "--fov 200: the field of view is 200 degrees, must be above 0 and below 180"),
        (("--fov", "90", "--width", "64"), "give --size"),
        (("--fov", "90", "--yaw", "nan"), "--yaw nan: write a number of degrees"),
        (("--fov", "90", "--pitch", "-inf"), "--pitch -inf: write a number of degrees"),
        (("--fps", "30"), "give --mp4 too"),
        (("--size", "8x8"), "give --fov too"),
    ],
)
def test_wrong_options(
    ply: Path,
    poses: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    line: str,
) -> None:
    monkeypatch.chdir(poses.parent)
    assert line in one_line(render(ply, "-o", "out", *options))
    assert not (tmp_path / "out").exists()


def test_what_is_neither_a_run_nor_a_model(tmp_path: Path) -> None:
    refused = render(tmp_path / "x.ply", "-o", tmp_path / "out", "--path", "3")
    assert "neither a run nor a PLY" in one_line(refused)


def test_pictures_along_a_path_are_written_one_by_one(ply: Path, poses: Path, tmp_path: Path) -> None:
    done = render(ply, "-o", tmp_path / "out", "--poses", poses, "--width", 32)
    assert (done.exit_code, done.stderr) == (0, f"{FRAMES} pictures in {tmp_path / 'out'}\n")
    assert len(list((tmp_path / "out").iterdir())) == FRAMES


@pytest.mark.parametrize("name", ["up.ply", "up.spz", "folder"])
def test_an_exported_model_without_its_run(ply: Path, poses: Path, tmp_path: Path, name: str) -> None:
    """Exports are read through a temporary PLY, which was gone before the offset in that PLY was read."""
    if name == "folder":
        write_unpacked(tmp_path / name, ModelSource(ply))
    else:
        assert call("export", ply, "-o", tmp_path / name).exit_code == 0
    done = render(tmp_path / name, "-o", tmp_path / "out", "--poses", poses, "--width", 32)
    assert (done.exit_code, len(list((tmp_path / "out").iterdir()))) == (0, FRAMES), done.output
