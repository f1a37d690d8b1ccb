import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.sfm.faces import Faces, directions
from panolog.scene.projection import project_to_fractions

WIDTH = 512


def test_every_direction_belongs_to_one_view_well_inside_of_it() -> None:
    rays = np.random.default_rng(0).normal(size=(20_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    faces = Faces(WIDTH)
    owners = np.zeros(len(rays), int)
    for face, rotation in enumerate(faces.rotations):
        local = rays @ rotation
        pixels = local[:, :2] / local[:, 2:] * faces.focal + faces.size / 2
        inside = (local[:, 2] > 0) & ((pixels > 16) & (pixels < faces.size - 16)).all(axis=1)
        where, own = faces.to_panorama(pixels[inside], face)
        assert np.allclose(where, project_to_fractions(rays[inside]) * (WIDTH, WIDTH // 2), atol=1e-6)
        owners[np.flatnonzero(inside)[own]] += 1
    assert (owners == 1).all()


@pytest.mark.parametrize("face", range(12))
def test_a_view_shows_what_lies_in_its_direction(face: int) -> None:
    faces = Faces(WIDTH)
    seen = faces.view(_smooth(), face).astype(float)
    grid = np.arange(faces.size) + 0.5
    x, y = np.meshgrid(grid, grid)
    where, _ = faces.to_panorama(np.column_stack([x.ravel(), y.ravel()]), face)
    assert np.abs(seen.ravel() - _shade(where / (WIDTH, WIDTH // 2))).max() < 2.0


def test_views_stand_upright_around_the_horizon() -> None:
    upright = [rotation[1, 1] for rotation in Faces(WIDTH).rotations[2:]]
    assert min(upright) > 0.8
    assert np.allclose(directions()[:2], [[0, -1, 0], [0, 1, 0]])


def _smooth() -> NDArray[np.uint8]:
    u = (np.arange(WIDTH) + 0.5) / WIDTH
    v = (np.arange(WIDTH // 2) + 0.5) / (WIDTH // 2)
    fractions = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return np.rint(_shade(fractions)).astype(np.uint8).reshape(WIDTH // 2, WIDTH)


def _shade(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) a grey that is smooth on the sphere, also across the seam and the poles."""
    longitude = (fractions[:, 0] - 0.5) * 2 * np.pi
    latitude = (fractions[:, 1] - 0.5) * np.pi
    x, y = np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    z = np.cos(latitude) * np.cos(longitude)
    shade: NDArray[np.float64] = 127 + 40 * np.sin(3 * x + 1) + 40 * np.cos(4 * y - z)
    return shade
