"""What is measured in a strip, on images with a known step."""

import numpy as np
import pytest
import torch

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Grid
from panolog.partition.faces import planes_between
from panolog.workers.seams.strips import Difference, Errors, Look, Seen, Strip, directions, strip_of

WIDTH, RADIUS, MARGIN = 256, 4.0, 1.5
BOX = Aabb(np.full(3, -6.0), np.full(3, 6.0))
PLANE = planes_between(Grid((2, 1, 1)))[0]
LOOK = Look(np.eye(3), np.array([0.5, 0.0, 0.0]))
SIZE = (WIDTH // 2, WIDTH)


def rays() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return directions(np.arange(WIDTH * WIDTH // 2), WIDTH)


def sphere(color: int = 100) -> Seen:
    """A painted sphere around the camera."""
    full = np.ones(SIZE, np.float32)
    return Seen(np.full((*SIZE, 3), color, np.uint8), full, RADIUS * full)


def strip() -> Strip:
    return strip_of(PLANE, BOX, MARGIN, LOOK, sphere())


def test_a_strip_is_what_is_within_the_margin() -> None:
    x = LOOK.center[0] + RADIUS * rays()[:, 0]
    found = strip()
    np.testing.assert_array_equal(found.pixels, np.flatnonzero(np.abs(x) <= MARGIN))
    np.testing.assert_allclose(found.offsets, x[found.pixels], atol=1e-12)
    np.testing.assert_allclose(found.points[:, 0], x[found.pixels], atol=1e-12)


def test_its_area_is_that_on_the_sphere() -> None:
    """The zone of a sphere: 2πR·h, here of 4πR² in all, which are 2/π of all pixels at the equator."""
    everything = WIDTH * WIDTH // 2 * 2 / np.pi
    assert strip().area.sum() / everything == pytest.approx(2 * MARGIN / (2 * RADIUS), rel=0.01)


def test_neither_sky_nor_masked_pixels_are_in_a_strip() -> None:
    seen = sphere()
    seen.distance[:32] = 1e3  # the sky
    seen.distance[32:40] = 0.0  # nothing
    mask = torch.ones(SIZE, dtype=torch.bool)
    mask[-8:] = False
    rows = strip_of(PLANE, BOX, MARGIN, LOOK, seen, mask).pixels // WIDTH
    assert (rows.min(), rows.max()) == (40, SIZE[0] - 9)


def test_a_known_step_is_measured() -> None:
    found, truth = strip(), np.full((WIDTH * WIDTH // 2, 3), 100, np.uint8)
    color = np.where(found.offsets[:, None] >= 0, 120, 100).astype(np.uint8).repeat(3, axis=1)
    errors = Errors()
    errors.add(PLANE, found, color, truth[found.pixels], 1.0)
    error, step = errors.means
    assert step == pytest.approx(20 / 255)
    above = found.area[found.offsets >= 0].sum() / found.area.sum()
    assert error == pytest.approx(20 / 255 * np.sqrt(above))


def test_what_goes_on_across_the_face_is_an_error_but_no_step() -> None:
    found = strip()
    truth = np.random.default_rng(0).integers(0, 200, (len(found.pixels), 3)).astype(np.uint8)
    errors = Errors()
    errors.add(PLANE, found, truth + np.uint8(10), truth, 1.0)
    error, step = errors.means
    assert error == pytest.approx(10 / 255)
    assert step == pytest.approx(0.0, abs=1e-12)


def test_nothing_seen_has_no_errors() -> None:
    assert Errors().means == (None, None)
    assert set(Difference().means.values()) == {None}


def test_what_two_blocks_show_differs_by_known_amounts() -> None:
    found = strip()
    below, above = sphere(100).at(found.pixels), sphere(151).at(found.pixels)
    above.distance[:] = 1.25 * RADIUS
    above.alpha[:] = 0.75
    difference = Difference()
    difference.add(found, below, above)
    assert difference.means == pytest.approx(
        {"color": 0.2, "psnr": -20 * np.log10(0.2), "depth": 0.25, "opacity": 0.25}
    )
