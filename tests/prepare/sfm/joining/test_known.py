"""Which points a scene has after panoramas were added: its own as they are, and those that are new."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.sfm.joining.known import KnownScene, with_new
from panolog.prepare.sfm.sparse_model import SparseModel
from panolog.scene.model import Scene
from panolog.scene.projection import project_to_fractions
from panolog.scene.write import PosedImage

Array = NDArray[np.float64]
SIZE = (1024, 512)
SHIFTS = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])  # translations; the last panorama is new
OWN = np.array([[2.0, 0.5, 4.0], [-3.0, 1.0, 2.0]])  # the scene's points
FOUND = np.array([OWN[0] + 1e-4, [1.0, 1.0, -5.0], [4.0, -2.0, 1.0]])  # its first one again; two others


def _seen(shift: int, points: Array, off: float = 0.0) -> Array:
    """Where a panorama sees points (N, 3), so many pixels aside."""
    where: Array = project_to_fractions(points + SHIFTS[shift]) + np.array([off / SIZE[0], 0.0])
    return where


@pytest.mark.parametrize("off", [0.3, 4.0])
def test_a_point_that_is_found_again_is_not_new_and_stays(off: float) -> None:
    """Args: off, pixels between the scene's point and where the new panorama sees it: too many count not."""
    both = np.arange(2)
    images = tuple(
        PosedImage(f"{row}", Path(), np.eye(3), SHIFTS[row], (both, _seen(row, OWN))) for row in range(2)
    )
    scene = Scene(Path(), *SIZE, (), OWN, np.zeros((2, 3), np.uint8), (0, 1), (), "")
    known = KnownScene(scene, images, (), None, None)
    rows = np.arange(3)  # of the points found: the last is seen by the scene's panoramas alone
    sightings = [(rows, _seen(row, FOUND)) for row in range(2)]
    sightings.append((rows[:2], np.concatenate([_seen(2, FOUND[:1], off), _seen(2, FOUND[1:2])])))
    found = SparseModel((0, 1, 2), np.stack([np.eye(3)] * 3), SHIFTS + 1e-9, FOUND, tuple(sightings))
    whole = with_new(known, found, SIZE, most=2.0)
    assert np.array_equal(whole.points, [*OWN, FOUND[1]])
    assert np.array_equal(whole.translations[:2], SHIFTS[:2])
    assert [rows.tolist() for rows, _ in whole.sightings[:2]] == [[0, 1, 2]] * 2
    assert np.array_equal(whole.sightings[0][1][:2], images[0].sightings[1])
    assert whole.sightings[2][0].tolist() == ([0, 2] if off < 2 else [2])
