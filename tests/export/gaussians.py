"""Gaussians for the tests of file formats."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from panolog.export.reading import read_model
from panolog.export.splats import REST, Splats
from panolog.scene.errors import InputError

Triple = tuple[float, float, float]

C0 = 0.28209479177387814  # spherical harmonic of degree 0


def scattered(
    count: int, degree: int = 3, *, seed: int = 0, extent: float = 50.0, size: float = 0.05
) -> Splats:
    """Gaussians of all kinds around the origin, within what every format can hold."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    columns = {
        "means": rng.uniform(-extent, extent, (count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": rng.normal(np.log(size), 0.7, (count, 3)).clip(-9, 4),
        "opacities": rng.normal(0, 2, count),
        "sh0": rng.normal(0, 1, (count, 3)).clip(-3, 3),
        "shN": rng.normal(0, 0.2, (count, REST[degree], 3)).clip(-0.8, 0.8),
    }
    return Splats(**{name: column.astype(np.float32) for name, column in columns.items()})


def cluster(place: Triple, color: Triple, *, spread: float = 0.5) -> Splats:
    """400 opaque balls of one colour around a place."""
    rng, count = np.random.default_rng(1), 400
    shade = (np.array(color) - 0.5) / C0
    return Splats(
        means=(np.array(place) + rng.normal(0, spread, (count, 3))).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), np.log(0.3 * spread), np.float32),
        opacities=np.full(count, 4, np.float32),
        sh0=np.tile(shade.astype(np.float32), (count, 1)),
        shN=np.zeros((count, 3, 3), np.float32),
    )


def matched(splats: Splats, means: NDArray[np.float32]) -> Splats:
    """The same Gaussians in another order: that of means (N, 3) which are about theirs."""
    _, rows = cKDTree(splats.means).query(means)
    assert len(np.unique(rows)) == len(splats) == len(means)
    return splats.select(rows)


def turn_between(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N,) degrees between unit quaternions (N, 4)."""
    cosine = np.abs((first.astype(np.float64) * second).sum(axis=1)).clip(0, 1)
    return np.asarray(np.degrees(2 * np.arccos(cosine)))


def line_of(path: Path) -> str:
    """What is wrong with a file, on one line; nothing if it can be read as Gaussians that are finite."""
    try:
        found = read_model(path)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 500
        return str(error)
    assert all(np.isfinite(column).all() for column in found.columns().values())
    assert len({len(column) for column in found.columns().values()}) == 1
    return ""
