import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.sfm.links import find_links

Array = NDArray[np.float64]
SIGMA = 1e-3  # radians


def _walk(bridge: int) -> tuple[Array, Array, list[NDArray[np.int64]]]:
    """Twelve cameras in a row; the first six and the last six share `bridge` points only."""
    random = np.random.default_rng(5)
    centers = np.column_stack([np.arange(12.0), np.zeros(12), np.zeros(12)])
    near = [random.uniform((x - 4, 2, -2), (x + 4, 8, 4), (600, 3)) for x in (2.5, 8.5)]
    shared = random.uniform((4, 25, -2), (7, 35, 4), (bridge, 3))  # far away
    both = 1200 + np.arange(bridge)
    seen = []
    for camera, center in enumerate(centers):
        part = camera // 6
        own = 600 * part + np.flatnonzero(np.abs(near[part][:, 0] - center[0]) < 2.5)
        seen.append(np.concatenate([own, both]))
    return centers, np.concatenate([*near, shared]), seen


def test_the_weakest_link_is_the_one_that_few_points_carry() -> None:
    found = find_links(*_walk(12), SIGMA)
    weakest = found[0]
    assert weakest.points == 12
    assert weakest.between in {(4, 5), (5, 6), (6, 7)}
    assert weakest.scale_error > 3 * found[1].scale_error


def test_its_error_is_the_one_that_noise_makes() -> None:
    centers, points, seen = _walk(12)
    predicted = find_links(centers, points, seen, SIGMA)[0].scale_error
    random = np.random.default_rng(7)
    ratios = [_scale_ratio(centers, points[1200:], random) for _ in range(400)]
    assert np.std(ratios) == pytest.approx(predicted, rel=0.25)


def test_parts_that_no_point_holds_together_have_no_common_scale() -> None:
    centers, points, seen = _walk(12)
    seen = [rows[rows < 1200] if camera != 5 else rows for camera, rows in enumerate(seen)]
    weakest = find_links(centers, points, seen, SIGMA)[0]  # camera 5 sees what the second part does
    assert weakest.points == 0
    assert weakest.scale_error == float("inf")


def _scale_ratio(centers: Array, points: Array, random: np.random.Generator) -> float:
    """The ratio of distances as two parts measure them with noise, each with exact poses of its own."""
    total, weights = 0.0, 0.0
    for point in points:
        distances, variances = [], []
        for part in (centers[:6], centers[6:]):
            middle = part.mean(axis=0)
            ray = (point - middle) / np.linalg.norm(point - middle)
            rays = point - part
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            noisy = rays + random.normal(0, SIGMA, rays.shape)
            noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
            normal = np.eye(3) - noisy[:, :, None] * noisy[:, None, :]
            met = np.linalg.solve(normal.sum(axis=0), (normal @ part[:, :, None])[:, :, 0].sum(axis=0))
            exact = np.linalg.norm(point - middle)
            distances.append((met - middle) @ ray / exact)
            off = part - middle
            across = (off**2).sum() - ((off @ ray) ** 2).sum()
            variances.append((exact * SIGMA) ** 2 / across)
        total += np.log(distances[0] / distances[1]) / sum(variances)
        weights += 1 / sum(variances)
    return total / weights
