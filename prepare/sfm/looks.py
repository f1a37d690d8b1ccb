"""Which panoramas look alike, by a few of their features: a fraction of what matching all of them takes.

The largest features of a panorama are few and return most often (C. Wu, Towards Linear-Time Incremental
Structure from Motion, 3DV 2013: preemptive matching).
"""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_LARGEST = 256  # features of each panorama
_AT_ONCE = 32  # panoramas that one is compared with
_RATIO = 0.8  # of the distance to the second nearest, as COLMAP has it
_SQUARE = 512.0  # length of COLMAP's descriptors


def look_alikes(work: Workspace, most: int, progress: StageProgress) -> list[tuple[int, int]]:
    """Pairs of rows, ascending: each panorama with the `most` that share most of its largest features."""
    ids = work.ids()
    with pycolmap.Database.open(work.database) as database:
        # (N, 128) of each. Products of descriptors are whole and below 2^24: exact in any order.
        words = [np.asarray(database.read_descriptors(it).data[:_LARGEST], np.float32) for it in ids]
    shared = np.zeros((len(ids), len(ids)), np.int16)
    for row, own in enumerate(words):
        progress("look-alikes", row, len(ids))
        for start in range(0, row, _AT_ONCE):
            others = words[start : min(row, start + _AT_ONCE)]
            close = (
                own @ np.concatenate(others).T
            )  # many at once: BLAS's threads cost more than small products
            parts = np.split(close, np.cumsum([len(other) for other in others])[:-1], axis=1)
            for other, part in enumerate(parts, start=start):
                shared[row, other] = shared[other, row] = _matches(part)
    progress("look-alikes", len(ids), len(ids))
    pairs = {
        (min(row, other), max(row, other))
        for row, counts in enumerate(shared)
        for other in np.argsort(-counts, kind="stable")[:most].tolist()
        if counts[other] > 0
    }
    return sorted(pairs)


def _matches(close: NDArray[np.float32]) -> int:
    """How many features are nearest to each other and clearly nearer than the second.

    Args: close (N, M) the products of the descriptors of two panoramas; it is overwritten.
    """
    if min(close.shape) < 2:
        return 0
    best, rows = close.argmax(axis=1), np.arange(len(close))
    nearest = close[rows, best]
    mutual = close.max(axis=0)[best] == nearest
    first = nearest / _SQUARE**2
    close[rows, best] = 0
    angles = np.arccos(np.minimum([first, close.max(axis=1) / _SQUARE**2], 1))
    return int((mutual & (angles[0] < _RATIO * angles[1])).sum())
