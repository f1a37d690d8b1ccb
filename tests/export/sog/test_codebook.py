"""Codebooks and palettes: near the best, for any numbers, and the same with any number of threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.export.sog.codebook import SIZE, Histogram, nearest
from panolog.export.sog.palette import Palette, make_palette, step_of, units
from tests.export.sog.models import splats

RNG = np.random.default_rng(5)
SHAPES = {
    "normal": RNG.normal(size=700),
    "two heaps": np.concatenate([RNG.normal(-3, 0.1, 300), RNG.normal(5, 1, 400)]),
    "spike": np.concatenate([np.zeros(5000), RNG.normal(0, 0.1, 500)]),
    "skew": np.exp(RNG.normal(0, 1, 700)),
}


@pytest.mark.parametrize("size", [3, 16, 100])
@pytest.mark.parametrize("name", SHAPES)
def test_it_is_nearly_optimal(name: str, size: int) -> None:
    values = np.sort(SHAPES[name]).astype(np.float32)
    entries = Histogram.of(values).codebook(size)
    assert entries.shape == (size,) and (np.diff(entries) >= 0).all()
    error = np.square(values.astype(np.float64) - entries[nearest(entries, values)]).sum()
    assert error <= 1.05 * optimum(values, size)


def optimum(values: NDArray[np.float32], size: int) -> float:
    """The least error of any codebook, by dynamic programming over all partitions of sorted values."""
    places, counts = np.unique(values.astype(np.float64), return_counts=True)
    number, first, second = (np.concatenate([[0.0], np.cumsum(counts * places**k)]) for k in range(3))
    begin, end = np.ogrid[: len(places) + 1, : len(places) + 1]
    mean = (first[end] - first[begin]) ** 2 / np.maximum(number[end] - number[begin], 1)
    cost = np.where(begin < end, (second[end] - second[begin] - mean).clip(0), np.inf)
    best = cost[0].copy()
    for _ in range(size - 1):
        best = (best[:, None] + cost).min(axis=0)
    return float(best[-1])


def test_few_numbers_are_entries() -> None:
    values = np.array([3.5, -1.25, 3.5, 7.0], np.float32)
    entries = Histogram.of(values).codebook()
    assert entries.shape == (SIZE,)
    np.testing.assert_array_equal(entries[nearest(entries, values)], values)


def test_an_outlier_does_not_take_the_entries() -> None:
    values = np.concatenate([RNG.normal(0, 0.1, 5000), [1e6, -1e5, 3e7]]).astype(np.float32)
    entries = Histogram.of(values).codebook()
    found = entries[nearest(entries, values)]
    assert np.abs(found - values)[:5000].max() < 0.05
    np.testing.assert_allclose(found[5000:], values[5000:], rtol=1e-3)


def test_pieces_are_as_the_whole() -> None:
    values = RNG.normal(size=9000).astype(np.float32)
    joined = Histogram()
    for piece in np.array_split(values, 7):
        joined.add(Histogram.of(piece))
    np.testing.assert_allclose(joined.codebook(), Histogram.of(values).codebook(), rtol=1e-6)


def test_weights_count() -> None:
    values = RNG.normal(size=3000).astype(np.float32)
    weights = RNG.integers(1, 5, 3000)
    repeated = Histogram.of(np.repeat(values, weights)).codebook(20)
    np.testing.assert_allclose(
        Histogram.of(values, weights.astype(np.float32)).codebook(20), repeated, rtol=1e-5
    )


def vectors(count: int, seed: int = 2) -> NDArray[np.float32]:
    return splats(count, seed=seed).shN.reshape(count, 45)


def made(model: NDArray[np.float32], weights: NDArray[np.float32], size: int, threads: int = 2) -> Palette:
    step = step_of(model)
    with ThreadPoolExecutor(threads) as pool:
        return make_palette(units(model, step), step, weights, size, pool)


def test_it_is_near_the_best_of_k_means() -> None:
    model = vectors(6000)
    palette = made(model, np.ones(len(model), np.float32), 256)
    steps = units(model, palette.step)
    labels = palette.labels(steps)
    palette.add(steps, labels, np.ones(len(model), np.float32))
    found = palette.means()[labels] * palette.step
    rng = np.random.default_rng(0)
    entries = model[rng.permutation(len(model))[:256]].astype(np.float64)
    for _ in range(10):
        nearest = (model @ entries.T - (entries**2).sum(1) / 2).argmax(1)
        counts = np.bincount(nearest, minlength=256)
        sums = np.stack([np.bincount(nearest, column, minlength=256) for column in model.T], axis=1)
        entries = np.where(counts[:, None] > 0, sums / counts.clip(1)[:, None], entries)
    assert np.square(found - model).sum() < 1.1 * np.square(entries[nearest] - model).sum()


def test_threads_and_blas_do_not_change_it() -> None:
    model = vectors(12_000)
    weights = np.random.default_rng(0).integers(1, 60_000, len(model)).astype(np.float32)
    found = []
    for threads in (1, 3):
        palette = made(model, weights, 400, threads)
        steps = units(model, palette.step)
        for rows in np.array_split(np.arange(len(model))[:: 1 if threads == 1 else -1], threads * 2 + 1):
            palette.add(steps[rows], palette.labels(steps[rows]), weights[rows])
        found.append((palette.entries, palette.means()))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
