"""Features of large panoramas in bounded memory, and processes that are killed."""

import os
import signal
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.sfm import features
from panolog.prepare.sfm.conformal_views import BAND, Faces
from panolog.prepare.sfm.features import Features, features_of, processes_for
from panolog.prepare.sfm.workspace import silence_colmap
from panolog.scene.errors import RunError

GIB = 2**30


@pytest.fixture(scope="module")
def panorama(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random blobs of many sizes, 1024 pixels wide."""
    path, random = tmp_path_factory.mktemp("features") / "a.png", np.random.default_rng(0)
    octaves = [random.uniform(0, 255, (512 >> it, 1024 >> it)).astype(np.float32) for it in range(4, 8)]
    blobs = sum(cv2.resize(it, (1024, 512), interpolation=cv2.INTER_CUBIC) for it in octaves) / len(octaves)
    cv2.imwrite(str(path), np.rint(blobs).clip(0, 255).astype(np.uint8))
    return path


def test_tiles_find_the_features_of_the_whole(panorama: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with silence_colmap():
        whole = features_of(panorama, [])
        monkeypatch.setattr(features, "_TILE", 40_000)
        tiled = features_of(panorama, [])
    assert len(Faces(1024).tiles(BAND, 40_000)) > 5
    apart = np.linalg.norm(whole.pixels[:, None] - tiled.pixels[None], axis=2).min(axis=1)
    assert len(whole.pixels) > 500
    assert (apart[len(apart) // 2 :] < 0.1).mean() > 0.95  # large ones are found on coarser grids
    assert len(tiled.pixels) == pytest.approx(len(whole.pixels), rel=0.05)


def test_processes_fit_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    assert processes_for(2048, 64 * GIB, 100) == 16
    assert processes_for(2048, 64 * GIB, 3) == 3
    assert processes_for(8192, 24 * GIB, 100) == 10
    assert processes_for(8192, GIB, 100) == 1


def killed_once(path: Path, masks: Iterable[Path]) -> Features:
    """What is numbered as `path`; the first process that gets to 2 is killed."""
    if path.name == "2" and not path.with_name("killed").exists():
        path.with_name("killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Features(np.full((1, 2), float(path.name), np.float32), np.zeros((1, 128), np.uint8))


def always_killed(path: Path, masks: Iterable[Path]) -> Features:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def test_a_killed_process_is_one_line_and_fewer_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(features, "features_of", killed_once)
    found = list(features._in_processes([(tmp_path / str(row), []) for row in range(5)], 2))
    assert [it.pixels[0, 0] for it in found] == [0, 1, 2, 3, 4]
    assert [record.getMessage() for record in caplog.records] == [
        "a process that finds features was killed, most likely for want of memory: 1 at a time now"
    ]


def test_a_panorama_that_no_process_survives_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(features, "features_of", always_killed)
    with pytest.raises(RunError, match=r"pano\.jpg: the process that finds its features was killed"):
        list(features._in_processes([(tmp_path / "pano.jpg", [])], 1))
