"""A palette of spherical harmonics: few vectors that stand for those of all Gaussians.

Vectors are clustered by k-means on two levels: cells, and entries in each cell. A vector is compared with the
entries of its nearest cells alone, which finds nearly the best of 65,536 at a fiftieth of the cost.

Coefficients are rounded to integers of at most `_LARGEST`. Products and sums of those are exact in float32,
so that no library, order or number of threads changes a byte.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from threading import Lock

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST = 65_536  # entries, by the format: labels have 16 bits
_SAMPLED, _MOST_SAMPLED = 16, 2**19  # vectors of a sample for each entry, about, and in all: 94 MB
_SHARE = 32  # Gaussians for each entry: the palette then takes a tenth of the file
_FEW = 1024  # entries that a palette has if there are as many Gaussians: 48 kB
_ROW = 64  # entries in a row of the palette's image
_CELLS = 256  # at most
_PROBES = 4  # nearest cells whose entries are compared
_LARGEST = 350  # |x·c − c·c/2| of 45 coefficients is a multiple of 1/2 below 2²³, which float32 holds exactly
_CLIP = 8.0  # times what 99.9 % of the coefficients do not exceed: beyond, they are clipped
_COARSE_ROUNDS, _FINE_ROUNDS, _ROUNDS = 8, 4, 2
_ROWS = 16_384  # vectors compared at a time
_SEED = 0
_PRODUCTS = 262_144  # of a product of matrices that OpenBLAS computes in the calling thread: ours are as many
_COLUMNS = 256  # of such a product


def palette_size(count: int) -> int:
    """Entries of the palette of `count` Gaussians."""
    wanted = max(_FEW, -(-count // _SHARE))
    return min(count, MOST, -(-wanted // _ROW) * _ROW)


def sample_size(count: int) -> int:
    """Gaussians, about, that the palette of `count` is made from; all of them move its entries afterwards."""
    return min(_SAMPLED * palette_size(count), _MOST_SAMPLED)


@dataclass(eq=False)
class Palette:
    """K entries of D numbers, by cells."""

    step: float  # what one unit of an entry is
    cells: Floats  # (A, D) integers
    starts: Integers  # (A + 1,) where the entries of each cell begin
    entries: Floats  # (K, D) integers, cell after cell
    sums: Doubles = field(init=False)  # (K, D) of weighted vectors
    weights: Doubles = field(init=False)  # (K,) of these vectors
    _lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self.forget()

    def labels(self, vectors: Floats) -> Integers:
        """(N,) the entry of each vector (N, D), in steps."""
        parts = [self._labels(vectors[start : start + _ROWS]) for start in range(0, len(vectors), _ROWS)]
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)

    def forget(self) -> None:
        """Starts new sums."""
        self.sums, self.weights = np.zeros(self.entries.shape), np.zeros(len(self.entries))

    def add(self, vectors: Floats, labels: Integers, weights: Floats) -> None:
        """Adds vectors (N, D), in steps, to the sums of their entries, from any thread.

        Args: labels (N,) as found; weights (N,), positive integers of at most 65,535.
        """
        if not len(labels):
            return
        order = np.argsort(labels, kind="stable")
        used, first = np.unique(labels[order], return_index=True)
        weighted = vectors[order].astype(np.float64) * weights[order, None]
        sums = np.add.reduceat(weighted, first, axis=0)
        masses = np.add.reduceat(weights[order].astype(np.float64), first)
        with self._lock:  # sums of integers: the order of the threads does not matter
            self.sums[used] += sums
            self.weights[used] += masses

    def means(self) -> Doubles:
        """(K, D) the mean of the vectors of each entry, in steps; the entry itself if it has none."""
        return np.where(self.weights[:, None] > 0, self.sums / self.weights.clip(1)[:, None], self.entries)

    def _labels(self, vectors: Floats) -> Integers:
        near = self._near(vectors)
        order = np.argsort(near, axis=None, kind="stable")
        rows, ends = order // near.shape[1], np.cumsum(np.bincount(near.ravel(), minlength=len(self.cells)))
        found, score = np.empty(near.size, np.int64), np.full(near.size, -np.inf, np.float32)
        half = _half(self.entries)
        for cell, end in enumerate(ends):
            pairs = slice(ends[cell - 1] if cell else 0, end)
            own = slice(self.starts[cell], self.starts[cell + 1])
            if pairs.start < pairs.stop and own.start < own.stop:
                scores = _products(vectors[rows[pairs]], self.entries[own])
                scores -= half[own]
                best = scores.argmax(axis=1)
                found[order[pairs]] = best + own.start
                score[order[pairs]] = scores[np.arange(len(best)), best]
        best = score.reshape(near.shape).argmax(axis=1)
        return np.asarray(found.reshape(near.shape)[np.arange(len(near)), best])

    def _near(self, vectors: Floats) -> NDArray[np.int16]:
        """(N, P) the nearest cells of vectors (N, D)."""
        if len(self.cells) == 1:
            return np.zeros((len(vectors), 1), np.int16)
        scores = _products(vectors, self.cells)
        scores -= _half(self.cells)
        near = np.empty((len(vectors), min(_PROBES, len(self.cells))), np.int16)
        for probe in range(near.shape[1]):
            near[:, probe] = best = scores.argmax(axis=1)
            scores[np.arange(len(best)), best] = -np.inf
        return near


def make_palette(vectors: Floats, step: float, weights: Floats, size: int, pool: Executor) -> Palette:
    """A palette for what a sample is taken from, the same with any number of threads.

    Args: vectors (S, D) of the sample in steps, S at least 1; step; weights (S,), positive integers of at
    most 65,535; size, how many entries; pool, threads to use.
    """
    cells = int(min(_CELLS, max(1, round(size**0.5))))
    few = np.arange(0, len(vectors), -(-len(vectors) // (_CELLS * cells)))
    coarse = _clustered(vectors, weights, few, cells, _COARSE_ROUNDS)
    owner = _labels(_flat(coarse), vectors, pool)
    shares = _shares(vectors, weights, coarse, owner, size)
    members = np.split(np.argsort(owner, kind="stable"), np.cumsum(np.bincount(owner, minlength=cells))[:-1])
    parts = pool.map(partial(_clustered, vectors, weights, rounds=_FINE_ROUNDS), members, shares.tolist())
    palette = Palette(step, coarse, np.concatenate([[0], np.cumsum(shares)]), np.concatenate(list(parts)))
    for _ in range(_ROUNDS):
        palette.forget()
        labels = _labels(palette, vectors, pool)
        for start in range(0, len(vectors), _ROWS):
            part = slice(start, start + _ROWS)
            palette.add(vectors[part], labels[part], weights[part])
        palette.entries = np.rint(palette.means()).astype(np.float32)
    palette.forget()
    return palette


def units(vectors: Floats, step: float) -> Floats:
    """(N, D) vectors (N, D) in whole steps, clipped to `_LARGEST`."""
    return np.asarray(np.rint(vectors * np.float32(1 / step)).clip(-_LARGEST, _LARGEST), np.float32)


def _labels(palette: Palette, vectors: Floats, pool: Executor) -> Integers:
    parts = np.array_split(vectors, max(1, len(vectors) // _ROWS))
    return np.concatenate(list(pool.map(palette.labels, parts)))


def step_of(sample: Floats) -> float:
    """What one step is for vectors (S, D)."""
    sizes = np.abs(sample).ravel()
    usual = float(np.quantile(sizes, 0.999)) * _CLIP
    largest = float(sizes.max(initial=0))
    return (min(largest, usual) or largest or 1.0) / _LARGEST


def _shares(vectors: Floats, weights: Floats, coarse: Floats, owner: Integers, size: int) -> Integers:
    """(A,) how many of `size` entries each cell gets: more for more, and more different, vectors."""
    mass = np.zeros(len(coarse))
    for start in range(0, len(vectors), _ROWS):
        part = slice(start, start + _ROWS)
        errors = np.square(vectors[part] - coarse[owner[part]]).sum(axis=1, dtype=np.float64) * weights[part]
        mass += np.bincount(owner[part], errors, minlength=len(coarse))
    wanted = np.sqrt(mass * np.bincount(owner, minlength=len(coarse))) + 1e-9
    wanted *= size / wanted.sum()
    shares = np.floor(wanted).astype(np.int64)
    rest = np.argsort(shares - wanted, kind="stable")
    shares[rest[: size - shares.sum()]] += 1
    return np.asarray(shares, np.int64)


def _clustered(vectors: Floats, weights: Floats, rows: Integers, size: int, rounds: int) -> Floats:
    """(size, D) the centres of k-means of some rows of vectors (N, D); zeros if there are no rows."""
    if not len(rows) or not size:
        return np.zeros((size, vectors.shape[1]), np.float32)
    chosen = np.random.default_rng(_SEED).permutation(rows)[:size]
    flat = _flat(vectors[np.resize(chosen, size)])
    for _ in range(rounds if size < len(rows) else 0):
        flat.forget()
        for start in range(0, len(rows), _ROWS):
            part = rows[start : start + _ROWS]
            flat.add(vectors[part], flat.labels(vectors[part]), weights[part])
        flat.entries = np.rint(flat.means()).astype(np.float32)
    return flat.entries


def _flat(entries: Floats) -> Palette:
    """A palette of one cell, of which every entry is compared."""
    whole = np.array([0, len(entries)], np.int64)
    return Palette(1.0, np.zeros((1, entries.shape[1]), np.float32), whole, entries)


def _half(entries: Floats) -> Floats:
    """(K,) half of the squared length of entries (K, D)."""
    return np.asarray(np.square(entries).sum(axis=1) * np.float32(0.5), np.float32)


def _products(vectors: Floats, entries: Floats) -> Floats:
    """(N, K) the products of vectors (N, D) and entries (K, D), in parts that wake no other thread."""
    out = np.empty((len(vectors), len(entries)), np.float32)
    for start in range(0, len(entries), _COLUMNS):
        part = np.ascontiguousarray(entries[start : start + _COLUMNS].T)
        height = max(1, _PRODUCTS // part.size)
        whole = len(vectors) // height * height
        blocks = vectors[:whole].reshape(whole // height, height, len(part)) @ part
        out[:whole, start : start + _COLUMNS] = blocks.reshape(whole, part.shape[1])
        out[whole:, start : start + _COLUMNS] = vectors[whole:] @ part
    return out
