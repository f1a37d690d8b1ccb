"""Morton order: neighbours in space are neighbours in a file, which then compresses better."""

import numpy as np
from numpy.typing import NDArray

from panolog.export.splats import SplatSource, with_rows

_BITS = 21  # of each axis
# Spreads 21 bits to every third one of 63, in steps: shift, then mask.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N,) rows of points (N, 3) in Morton order of the cube around them; equal places keep their order."""
    if not len(means):
        return np.zeros(0, np.int64)
    low = means.min(axis=0).astype(np.float64)
    side = float((means.max(axis=0) - low).max()) or 1.0
    codes = np.zeros(len(means), np.uint64)
    for axis in range(3):
        place = (means[:, axis] - low[axis]) * ((2**_BITS - 1) / side)
        bits = place.astype(np.uint64)
        for shift, mask in _SPREAD:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        codes |= bits << np.uint64(axis)
    return np.argsort(codes, kind="stable")


def means_of(source: SplatSource) -> NDArray[np.float32]:
    """(N, 3) of all Gaussians of a source: 12 bytes of each."""
    means = np.empty((source.count, 3), np.float32)
    for rows, piece in with_rows(source):
        means[rows] = piece.means
    return means


def places_in(order: NDArray[np.int64]) -> NDArray[np.int32]:
    """(N,) where each row is in an order (N,) of rows."""
    places = np.empty(len(order), np.int32)
    places[order] = np.arange(len(order), dtype=np.int32)
    return places
