"""The Gaussians of a large model that cover most, for what cannot hold or draw all of them."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from panolog.export.splats import Splats, SplatSource, with_rows

_SAMPLE = 100_000  # Gaussians, about, from which the extent of a model is estimated


def extent(source: SplatSource) -> tuple[NDArray[np.float64], float]:
    """(3,) the median of the means, and the median distance from it, of a sample; at least one Gaussian."""
    step = max(1, source.count // _SAMPLE)
    means = np.concatenate([piece.means[::step] for piece in source.pieces()]).astype(np.float64)
    middle = np.median(means, axis=0)
    return middle, float(np.median(np.linalg.norm(means - middle, axis=1))) or 1.0


@dataclass(frozen=True, eq=False)
class Reduced:
    """The `most` Gaussians of a source that cover most, in its order, or all if there are no more.

    What one covers is its opacity times its solid angle from the middle of the scene; those closer than the
    median distance count as if they were at that distance. Equal ones go by their order.
    """

    source: SplatSource
    most: int
    _kept: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        """Reads the source twice. Raises what it raises."""
        count = self.source.count
        kept = np.ones(count, bool)
        if count > self.most:
            middle, radius = extent(self.source)
            covers = np.concatenate([_cover(piece, middle, radius) for piece in self.source.pieces()])
            kept[np.argsort(-covers, kind="stable")[self.most :]] = False
        object.__setattr__(self, "_kept", kept)

    @property
    def count(self) -> int:
        return min(self.source.count, self.most)

    @property
    def degree(self) -> int:
        return self.source.degree

    def pieces(self) -> Iterator[Splats]:
        """The Gaussians that are kept, in the pieces of the source."""
        for rows, piece in with_rows(self.source):
            if self._kept[rows].any():
                yield piece.select(self._kept[rows])


def _cover(piece: Splats, middle: NDArray[np.float64], radius: float) -> NDArray[np.float32]:
    """(n,) how much each covers, as a logarithm: see `Reduced`."""
    area = piece.scales.sum(axis=1) - piece.scales.min(axis=1)
    distance = np.linalg.norm(piece.means - middle, axis=1).clip(min=radius)
    return np.asarray(area - 2 * np.log(distance) - np.logaddexp(0, -piece.opacities), np.float32)
