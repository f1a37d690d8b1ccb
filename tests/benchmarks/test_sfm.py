"""The benchmark of poses: on a rendered street both ways find them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.sfm import measure
from panolog.scene.colmap import write_colmap
from panolog.scene.read import read_scene
from tests.prepare.video.videos import render, walk

WIDTH = 480


@pytest.mark.nightly
def test_a_short_street_is_found(tmp_path: Path) -> None:
    shots = walk([0.9] * 5)
    (tmp_path / "images").mkdir()
    poses = []
    for number, shot in enumerate(shots):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), render(shot, WIDTH))
        poses.append((f"{number}.png", np.eye(3), np.array([0.0, 0.0, -shot.along])))
    write_colmap(
        tmp_path / "sparse" / "0",
        poses,
        width=WIDTH,
        height=WIDTH // 2,
        points=np.random.default_rng(0).normal(size=(9, 3)),
        colors=np.zeros((9, 3), np.uint8),
        observations=[(np.empty(0, np.int64), np.empty((0, 2)))] * 5,
    )
    plain, ours = measure(read_scene(tmp_path))
    assert plain.registered in (0, 5)  # 0: COLMAP begins with no pair that moves along z
    assert (ours.registered, ours.contradictions) == (5, 0)
    assert ours.drift is not None and ours.drift < 1.0
    assert ours.step == pytest.approx(1.0, abs=0.05)
