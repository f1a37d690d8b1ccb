"""Matches along a known motion, where the same look returns all around."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.guided import match_along
from panolog.prepare.sfm.consistency.motion import Motion

Array = NDArray[np.float64]
COUNT, LOOKS = 240, 40
ERROR = np.deg2rad(0.5)


@pytest.fixture
def place() -> tuple[list[NDArray[np.float32]], tuple[Array, Array], Motion]:
    """Points of which six share each look, seen from two places, and the motion between these."""
    random = np.random.default_rng(2)
    points = random.normal(size=(COUNT, 3)) * (10, 3, 10)
    words = random.normal(size=(LOOKS, 128))[np.arange(COUNT) % LOOKS]
    words *= 512 / np.linalg.norm(words, axis=1, keepdims=True)
    rotation = Rotation.from_euler("YXZ", [40, 3, -2], degrees=True).as_matrix()
    shift = np.array([0.6, 0.1, -1.2])
    there = points @ rotation.T + shift
    rays = tuple(it / np.linalg.norm(it, axis=1, keepdims=True) for it in (points, there))
    order = random.permutation(COUNT)
    motion = Motion(rotation, shift / np.linalg.norm(shift))
    both = [words.astype(np.float32), words[order].astype(np.float32)]
    return both, (rays[0], rays[1][order]), motion


def test_what_returns_everywhere_is_clear_on_an_arc(
    place: tuple[list[NDArray[np.float32]], tuple[Array, Array], Motion],
) -> None:
    words, rays, motion = place
    found = match_along(words, rays, motion, ERROR)
    assert len(found) > 0.7 * COUNT
    there = rays[0][found[:, 0]] @ motion.rotation.T
    normals = np.cross(there, motion.direction)
    off = (normals * rays[1][found[:, 1]]).sum(axis=1) / np.linalg.norm(normals, axis=1)
    assert np.abs(off).max() <= np.sin(ERROR)
    assert (words[0][found[:, 0]] == words[1][found[:, 1]]).all(axis=1).mean() > 0.98
    everywhere = match_along(words, rays, motion, np.pi / 2)
    assert len(everywhere) < 0.05 * COUNT


def test_a_motion_back_finds_little(
    place: tuple[list[NDArray[np.float32]], tuple[Array, Array], Motion],
) -> None:
    words, rays, motion = place
    back = Motion(motion.rotation, -motion.direction)
    assert len(match_along(words, rays, back, ERROR)) < 0.2 * COUNT
