"""Codebooks: 256 numbers that stand for all numbers of a column, with the least sum of squared errors.

A histogram of all numbers is made first, in pieces: its bins are relative to a number's size, so that it
needs no bounds. Dynamic programming on groups of bins finds the best clusters, and Lloyd's iteration moves
their bounds between the groups.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

SIZE = 256  # entries
_BITS = 20  # of a bin's number: sign, exponent and 11 of the fraction, 1/2048 of a number's size
_FINE = 8  # groups of bins for each entry
_WIDEST = 64  # groups of an entry, at most
_EVEN = 0.5  # groups of equally many bins, for each one by density
_ROUNDS = 100


@dataclass(eq=False)
class Histogram:
    """How often numbers occur: the weight of each bin, and the sum of its numbers."""

    weights: Doubles = field(default_factory=lambda: np.zeros(2**_BITS))
    sums: Doubles = field(default_factory=lambda: np.zeros(2**_BITS))

    @staticmethod
    def of(values: Floats, weights: Floats | None = None) -> "Histogram":
        """The histogram of finite values of any shape. Args: weights of the same shape, None = 1."""
        # The bits of floats are integers in the same order if those of negative ones are turned.
        bits = np.ascontiguousarray(values, np.float32).ravel().view(np.uint32)
        turn = (bits >> np.uint32(31)) * np.uint32(0x7FFFFFFF) | np.uint32(0x80000000)
        bins = ((bits ^ turn) >> np.uint32(32 - _BITS)).astype(np.int64)
        each = np.ones(len(bins)) if weights is None else weights.ravel().astype(np.float64)
        mass, sums = (
            np.bincount(bins, column, minlength=2**_BITS) for column in (each, each * values.ravel())
        )
        return Histogram(np.asarray(mass, np.float64), np.asarray(sums, np.float64))

    def add(self, other: "Histogram") -> None:
        """Adds what another one has. Sums are not associative: add pieces in a fixed order."""
        self.weights += other.weights
        self.sums += other.sums

    def codebook(self, size: int = SIZE) -> Floats:
        """(size,) entries in ascending order; the last one is repeated if there are fewer numbers."""
        used = self.weights > 0
        weights, sums = self.weights[used], self.sums[used]
        means = sums / weights
        if len(means) <= size:
            return np.concatenate([means, np.full(size - len(means), means[-1])]).astype(np.float32)
        groups = _groups(means, weights, max(_FINE * size, size + 1))
        bounds = groups[_optimum(weights, sums, groups, size)]
        total, moment = (np.concatenate([[0.0], np.cumsum(column)]) for column in (weights, sums))
        for _ in range(_ROUNDS):
            entries = np.diff(moment[bounds]) / np.diff(total[bounds])
            inner = np.searchsorted(means, (entries[1:] + entries[:-1]) / 2)
            moved = np.concatenate([bounds[:1], inner, bounds[-1:]])
            if np.array_equal(moved, bounds) or (np.diff(moved) == 0).any():
                break
            bounds = moved
        return np.asarray(entries, np.float32)


def nearest(codebook: Floats, values: Floats) -> NDArray[np.uint8]:
    """The number of the nearest entry of each value, in the same shape."""
    middles = (codebook[1:].astype(np.float64) + codebook[:-1]) / 2
    return np.searchsorted(middles.astype(np.float32), values).astype(np.uint8)


def _groups(means: Doubles, weights: Doubles, wanted: int) -> Integers:
    """(G + 1,) where groups of neighbouring bins begin: about as many as wanted.

    Most of them as entries for very many numbers would be: their density is the cube root of that of the
    numbers (Panter and Dite, 1951). Others have equally many bins, or one outlier could take all.
    """
    edges = np.concatenate([means[:1], (means[1:] + means[:-1]) / 2, means[-1:]])
    dense = np.cbrt(weights * np.square(np.diff(edges)))
    share = np.cumsum(dense / dense.sum() + _EVEN / len(means))
    if len(means) <= wanted:
        return np.arange(len(means) + 1)
    marks = np.arange(1, wanted) * (share[-1] / wanted)
    return np.unique(np.concatenate([[0], np.searchsorted(share, marks) + 1, [len(means)]]))


def _optimum(weights: Doubles, sums: Doubles, groups: Integers, size: int) -> Integers:
    """(size + 1,) rows of `groups` at which the clusters of least error begin: by dynamic programming.

    A cluster has at most `_WIDEST` groups, which are about `_FINE` times as many as clusters.
    """
    mass = np.concatenate([[0.0], np.cumsum(np.add.reduceat(weights, groups[:-1]))])
    moment = np.concatenate([[0.0], np.cumsum(np.add.reduceat(sums, groups[:-1]))])
    count = len(mass) - 1
    # The squared numbers have the same sum in all partitions: a cluster's error is less by its gain.
    begin = np.arange(count + 1)[:, None] - np.arange(1, _WIDEST + 1)  # of a last cluster that ends at a row
    inside = begin >= 0
    begin = begin.clip(0)
    own = np.where(inside, mass[:, None] - mass[begin], 1)
    gains = np.where(inside, np.square(moment[:, None] - moment[begin]) / own, -np.inf)
    best = np.full(_WIDEST + count + 1, -np.inf)  # after as many rows as a cluster may have before the first
    best[_WIDEST] = 0
    before = sliding_window_view(best[:-1], _WIDEST)[:, ::-1]  # (count + 1, _WIDEST), as `begin`
    widths = np.empty((size, count + 1), np.uint8)
    for cluster in range(size):
        reached = before + gains
        widths[cluster] = reached.argmax(axis=1)
        best[_WIDEST:] = reached[np.arange(count + 1), widths[cluster]]
    found = [count]
    for cluster in range(size - 1, -1, -1):
        found.append(found[-1] - 1 - int(widths[cluster, found[-1]]))
    return np.array(found[::-1])
