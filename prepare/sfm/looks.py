"""Which panoramas look alike, by a few of their features: a fraction of what matching all of them takes.

The largest features of a panorama are few and return most often (C. Wu, Towards Linear-Time Incremental
Structure from Motion, 3DV 2013: preemptive matching).
"""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_LARGEST = 384  # features of each panorama
_RATIO = 0.8  # of the distance to the second nearest, as COLMAP has it
_SQUARE = 512.0  # length of COLMAP's descriptors


def look_alikes(work: Workspace, most: int, progress: StageProgress) -> list[tuple[int, int]]:
    """Pairs of rows, ascending: each panorama with the `most` that share most of its largest features."""
    ids = work.ids()
    with pycolmap.Database.open(work.database) as database:
        words = [_normed(database.read_descriptors(number).data[:_LARGEST]) for number in ids]
    shared = np.zeros((len(ids), len(ids)), np.int64)
    for row, own in enumerate(words):
        progress("look-alikes", row, len(ids))
        for other in range(row):
            shared[row, other] = shared[other, row] = _matches(own, words[other])
    progress("look-alikes", len(ids), len(ids))
    order = np.argsort(-shared, axis=1, kind="stable")[:, :most]
    pairs = {
        (min(row, other), max(row, other))
        for row in range(len(ids))
        for other in order[row].tolist()
        if shared[row, other] > 0
    }
    return sorted(pairs)


def _normed(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 128) descriptors as numbers. Their products are whole and below 2^24: exact in any order."""
    return np.asarray(descriptors, np.float32)


def _matches(one: NDArray[np.float32], other: NDArray[np.float32]) -> int:
    """How many of the features are nearest to each other and clearly nearer than the second."""
    if min(len(one), len(other)) < 2:
        return 0
    close = one @ other.T  # cosine, times the square of their length
    best = close.argmax(axis=1)
    mutual = close.argmax(axis=0)[best] == np.arange(len(one))
    top = np.partition(close, -2, axis=1)[:, -2:] / _SQUARE**2
    angle = np.arccos(np.clip(top, -1, 1))
    return int((mutual & (angle[:, 1] < _RATIO * angle[:, 0])).sum())
