"""Motions where most matches are clouds, which turn as the camera does, whatever it passes."""

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.distant import STILL, angles, common_rotation, direction_of_rest
from panolog.prepare.sfm.consistency.evidence import read_evidence
from panolog.prepare.sfm.consistency.motion import Geometries
from panolog.prepare.sfm.workspace import silence_colmap
from panolog.scene.projection import project_to_fractions
from tests.prepare.sfm.consistency.simulated import SIZE, database_of

Array = NDArray[np.float64]
_ERROR = 2.0 * 2 * np.pi / SIZE[0]  # radians: two pixels
_ROTATION = Rotation.from_euler("yxz", (40, 3, -2), degrees=True).as_matrix()
_DIRECTION = np.array([0.6, 0.0, 0.8])
_CLOUDS, _NEAR, _WRONG = 320, 40, 60


def _matches() -> tuple[Array, Array]:
    """(N, 3) directions of matches in both panoramas: clouds, then what is near, then wrong ones."""
    random = np.random.default_rng(3)

    def around(count: int) -> Array:
        rays = random.normal(size=(count, 3))
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    one = around(_CLOUDS + _NEAR + _WRONG)
    far = np.full((len(one), 1), 1e6)
    far[_CLOUDS:] = random.uniform(2, 6, (_NEAR + _WRONG, 1))
    other = far * one @ _ROTATION.T + _DIRECTION
    other[-_WRONG:] = around(_WRONG)
    other += 0.2 * _ERROR * far * random.normal(size=one.shape)
    return one, other / np.linalg.norm(other, axis=1, keepdims=True)


def test_clouds_give_the_rotation_and_the_rest_the_direction() -> None:
    one, other = _matches()
    begin = Rotation.from_euler("y", 0.5, degrees=True).as_matrix() @ _ROTATION
    rotation = common_rotation(one, other, begin, _ERROR)
    assert np.trace(rotation @ _ROTATION.T) > 1 + 2 * np.cos(np.deg2rad(0.1))
    moved = angles(one @ rotation.T, other) > STILL * _ERROR
    assert not moved[:_CLOUDS].any() and moved[_CLOUDS:].mean() > 0.9
    direction, fit = direction_of_rest(one[moved] @ rotation.T, other[moved], _ERROR)
    assert direction @ _DIRECTION > np.cos(np.deg2rad(2))
    near = np.flatnonzero(moved) < _CLOUDS + _NEAR
    assert fit[near].mean() > 0.9 and fit[~near].mean() < 0.1


def test_a_geometry_of_clouds_is_found_again_in_all_matches(tmp_path: Path) -> None:
    one, other = _matches()
    every = np.repeat(np.arange(len(one))[:, None], 2, axis=1)
    with silence_colmap():
        work = database_of(tmp_path, [project_to_fractions(rays) * SIZE for rays in (one, other)])
        first, second = work.ids()
        with pycolmap.Database.open(work.database) as database:
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = every[:_CLOUDS].astype(np.uint32)
            database.write_matches(first, second, every.astype(np.uint32))
            database.write_two_view_geometry(first, second, geometry)
        evidence = read_evidence(work, SIZE)
        geometries = Geometries(work, SIZE, 2.0, evidence)
        (pair,) = geometries.marked(evidence).pairs
        motion = geometries.motion(pair)
    assert motion is not None
    assert motion.direction @ _DIRECTION > np.cos(np.deg2rad(2))
    assert _NEAR * 0.9 < len(pair.telling) < _NEAR + 10
