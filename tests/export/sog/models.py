"""Models for the tests of SOG."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.export.sog.write import write_sog
from panolog.export.splats import REST, InMemory, Splats, SplatSource

Quats = NDArray[np.float32]


def splats(count: int, degree: int = 3, seed: int = 1) -> Splats:
    """Gaussians of many sizes around the origin, some far away; colours of neighbours are alike."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * np.where(rng.random((count, 1)) < 0.1, 300, 10)
    quats = rng.normal(size=(count, 4))
    kinds = rng.normal(0, 0.1, (20, REST[degree], 3))
    columns = {
        "means": means,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": rng.normal(-4, 1.5, (count, 3)),
        "opacities": rng.normal(0, 2, count),
        "sh0": np.sin(means / 20) + rng.normal(0, 0.3, (count, 3)),
        "shN": kinds[rng.integers(0, 20, count)] + rng.normal(0, 0.01, (count, REST[degree], 3)),
    }
    return Splats(**{name: column.astype(np.float32) for name, column in columns.items()})


def source(count: int, degree: int = 3, seed: int = 1) -> InMemory:
    """The same as a source."""
    return InMemory(splats(count, degree, seed))


def turned_alike(quats: Quats, as_these: Quats) -> Quats:
    """(N, 4) quaternions (N, 4), each with the sign of its counterpart: q and −q are the same rotation."""
    return np.asarray(quats * np.sign((quats * as_these).sum(axis=1, keepdims=True)), np.float32)


def write_unpacked(folder: Path, source: SplatSource) -> None:
    """A SOG as the folder that is in its file."""
    write_sog(packed := folder.with_suffix(".sog"), source)
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(folder)
    packed.unlink()
