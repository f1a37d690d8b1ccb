import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.sfm.conformal_views import BAND, DOWN, UP, Faces
from panolog.scene.projection import rays_of_fractions

WIDTH = 512


def test_every_direction_belongs_to_one_view_well_inside_of_it() -> None:
    faces = Faces(WIDTH)
    area = 0.0
    for face in (BAND, UP, DOWN):
        pixels = _pixels(faces, face)
        where, own = faces.to_panorama(pixels, face)
        latitude = (where[:, 1] / (WIDTH // 2) - 0.5) * np.pi
        size = np.cosh(np.arctanh(np.sin(latitude))) if face == BAND else 2 / (1 + np.sin(np.abs(latitude)))
        area += float((own / (size * faces.focal) ** 2).sum())
        inner = np.all((pixels > 6) & (pixels < np.array(faces.size(face)) - 6), axis=1)
        assert not np.any(own & ~inner)
    assert area == pytest.approx(4 * np.pi, rel=0.003)  # steradians: nothing is missing, nothing is twice


@pytest.mark.parametrize("face", [BAND, UP, DOWN])
def test_a_view_shows_what_lies_in_its_direction(face: int) -> None:
    faces = Faces(WIDTH)
    seen = faces.view(_smooth(), face).astype(float)
    where, _ = faces.to_panorama(_pixels(faces, face), face)
    assert np.abs(seen.ravel() - _shade(where / (WIDTH, WIDTH // 2))).max() < 2.0


@pytest.mark.parametrize("face", [BAND, UP, DOWN])
def test_views_keep_shapes_and_are_not_mirrored(face: int) -> None:
    faces = Faces(WIDTH)
    middle = np.array(faces.size(face)) * (0.4, 0.55)
    steps = [middle, (middle[0] + 0.5, middle[1]), (middle[0], middle[1] + 0.5)]
    where, _ = faces.to_panorama(np.array(steps), face)
    ray, right, down = rays_of_fractions(where / (WIDTH, WIDTH // 2))
    across, along = right - ray, down - ray
    assert np.linalg.norm(across) == pytest.approx(np.linalg.norm(along), rel=0.02)
    assert abs(across @ along) < 0.02 * np.linalg.norm(across) ** 2
    assert np.linalg.det([across, along, ray]) > 0


def _pixels(faces: Faces, face: int) -> NDArray[np.float64]:
    """(N, 2) the centres of all pixels of a view, row by row."""
    across, high = faces.size(face)
    x, y = np.meshgrid(np.arange(across) + 0.5, np.arange(high) + 0.5)
    return np.column_stack([x.ravel(), y.ravel()])


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
