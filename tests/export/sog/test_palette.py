"""Palettes of spherical harmonics: near the best, and the same with any number of threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from panolog.export.sog.palette import Palette, make_palette, step_of, units
from tests.export.sog.models import splats


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
