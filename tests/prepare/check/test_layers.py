"""What is said of sky masks that are not what they should be."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.check.layers import Layers, look_at_layers
from panolog.scene.errors import ImageError
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from tests.scenes import HEIGHT, WIDTH, write_scene

GROUND = np.full((HEIGHT, WIDTH), 255, np.uint8)
GROUND[: HEIGHT // 3] = 0


def with_sky(root: Path, mask: NDArray[np.uint8]) -> Scene:
    """A scene whose panoramas all have one sky mask."""
    names = [f"{index}.png" for index in range(4)]
    write_scene(root, names=names, points=400)
    (root / "skymasks").mkdir()
    for name in names:
        cv2.imwrite(str(root / "skymasks" / name), mask)
    return read_scene(root)


def look(scene: Scene, *, tracks: bool) -> Layers:
    unseen = np.zeros(0, np.int64)
    panoramas = [it if tracks else replace(it, observed=unseen) for it in scene.panoramas]
    return look_at_layers(replace(scene, panoramas=tuple(panoramas)))


@pytest.mark.parametrize("tracks", [True, False], ids=["tracks", "points alone"])
def test_inverted_sky_masks_are_a_problem(tracks: bool, tmp_path: Path) -> None:
    """Depth was dropped for want of points, and what the panoramas see became sky."""
    found = look(with_sky(tmp_path / "right", GROUND), tracks=tracks)
    assert found == Layers(("sky masks: 4 of 4 panoramas have one, and 22.2% is sky",), (), ())
    found = look(with_sky(tmp_path / "inverted", 255 - GROUND), tracks=tracks)
    assert found.lines == ("sky masks: 4 of 4 panoramas have one, and 77.8% is sky",)
    (problem,) = found.inverted
    assert problem.endswith("% of what the panoramas see lies on their sky: black is sky; invert them")


def test_sky_masks_of_classes_are_refused_before_training(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="its largest value is 11, so all of it would be sky"):
        look_at_layers(with_sky(tmp_path, np.where(GROUND > 0, 2, 11).astype(np.uint8)))
