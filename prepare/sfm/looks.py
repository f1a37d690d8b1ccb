"""Which panoramas look alike, by a few of their features: a fraction of what matching all of them takes.

The largest features of a panorama are few and return most often (C. Wu, Towards Linear-Time Incremental
Structure from Motion, 3DV 2013: preemptive matching). Of many panoramas, those are compared that share most
hashes of these features (M. Charikar, Similarity Estimation Techniques from Rounding Algorithms, STOC 2002:
signs of random projections): only products of few numbers are left for all pairs of panoramas.
"""

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csr_array

from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_LARGEST = 256  # features of each panorama
_AT_ONCE = 32  # panoramas that one is compared with
_RATIO = 0.8  # of the distance to the second nearest, as COLMAP has it
_SQUARE = 512.0  # length of COLMAP's descriptors
_FEW = 300  # panoramas of which each is compared with each, in 15 s
_CANDIDATES = 96  # panoramas that share most hashes, for each
_HASHES, _BITS = 32, 16  # of each feature
_WEIGHT = 16.0  # of a hash that half of the panoramas have: weights are whole, and sums the same everywhere

Words = list[NDArray[np.float32]]  # (N, 128) of each panorama


def look_alikes(work: Workspace, most: int, progress: StageProgress) -> list[tuple[int, int]]:
    """Pairs of rows, ascending: each panorama with the `most` that share most of its largest features."""
    ids = work.ids()
    with pycolmap.Database.open(work.database) as database:
        # Products of descriptors are whole and below 2^24: exact in any order.
        words = [np.asarray(database.read_descriptors(it).data[:_LARGEST], np.float32) for it in ids]
    shared: list[dict[int, int]] = [{} for _ in ids]
    for row, earlier in enumerate(_compared(words)):
        progress("look-alikes", row, len(ids))
        for start in range(0, len(earlier), _AT_ONCE):
            others = earlier[start : start + _AT_ONCE]
            # many at once: BLAS's threads cost more than small products
            close = words[row] @ np.concatenate([words[other] for other in others]).T
            parts = np.split(close, np.cumsum([len(words[other]) for other in others])[:-1], axis=1)
            for other, part in zip(others, parts, strict=True):
                shared[row][other] = shared[other][row] = _matches(part)
    progress("look-alikes", len(ids), len(ids))
    pairs = {
        (min(row, other), max(row, other))
        for row, counts in enumerate(shared)
        for other in sorted(counts, key=lambda it: (-counts[it], it))[:most]
        if counts[other] > 0
    }
    return sorted(pairs)


def _compared(words: Words) -> list[list[int]]:
    """For each panorama the earlier ones that it is compared with: all, or of many those with equal hashes.

    A hash counts for more, the fewer panoramas have it.
    """
    count = len(words)
    if count <= _FEW:
        return [list(range(row)) for row in range(count)]
    sums = [own.sum(axis=0, dtype=np.float64) for own in words]
    middle = np.rint(np.sum(sums, axis=0) / sum(map(len, words))).astype(np.float32)
    signs = np.random.default_rng(0).choice(np.array([-1, 1], np.float32), (len(middle), _HASHES * _BITS))
    # those of one panorama at a time: all of 3,000 would take 4 GB
    above = (((own - middle) @ signs > 0).reshape(len(own), _HASHES, _BITS) for own in words)
    hashes = np.concatenate([it @ (1 << np.arange(_BITS)) for it in above])
    columns = (hashes + (np.arange(_HASHES) << _BITS)).ravel()
    rows = np.repeat(np.arange(count), [_HASHES * len(own) for own in words])
    own = csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(count, _HASHES << _BITS))
    own.data[:] = 1  # those that a panorama has several times
    having = np.bincount(own.indices, minlength=own.shape[1])
    weights = np.rint(_WEIGHT * np.log2(count / np.maximum(having, 1))).astype(np.int32)
    weighted, others, pairs = csr_array(own * weights), csr_array(own.T), set[tuple[int, int]]()
    for row in range(count):
        score = (weighted[[row]] @ others).toarray()[0]
        score[row] = -1
        likely = np.argsort(-score, kind="stable")[:_CANDIDATES].tolist()
        pairs.update((max(row, other), min(row, other)) for other in likely)
    earlier: list[list[int]] = [[] for _ in range(count)]
    for row, other in sorted(pairs):
        earlier[row].append(other)
    return earlier


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
