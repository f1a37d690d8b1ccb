"""Exported frames: y is up, and what a Gaussian shows turns with it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.export.frame import Frame, sh_basis


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 1, 0), (1, 0, 0), (0.1, -2, 0.3)])
def test_up_becomes_y(up: tuple[float, float, float]) -> None:
    frame = Frame.upright(up)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame.rotation) == pytest.approx(1)
    length = float(np.linalg.norm(up))
    np.testing.assert_allclose(frame.points(np.array(up)), np.array([0, length, 0]), atol=1e-9)


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1)])
def test_up_that_is_no_direction(up: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="no direction"):
        Frame.upright(up)


def test_colours_turn_with_the_world() -> None:
    rng = np.random.default_rng(1)
    frame = Frame.upright((0.3, -0.5, 0.8), origin=np.array([10.0, 20, 30]))
    means, rest = rng.normal(size=(5, 3)).astype(np.float32), rng.normal(size=(5, 15, 3)).astype(np.float32)
    quats = Rotation.random(5, rng=rng).as_quat(scalar_first=True).astype(np.float32)
    moved, turned, shN = frame.turn(means, quats, rest)
    np.testing.assert_allclose(moved, (means - [10, 20, 30]) @ frame.rotation.T, atol=1e-5)
    before = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    after = Rotation.from_quat(turned, scalar_first=True).as_matrix()
    np.testing.assert_allclose(after, frame.rotation @ before, atol=1e-6)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = sh_basis(directions) @ rest
    np.testing.assert_allclose(sh_basis(directions @ frame.rotation.T) @ shN, seen, atol=1e-5)
