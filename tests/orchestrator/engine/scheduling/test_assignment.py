from itertools import product

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.engine.scheduling.assignment import assign_lpt


def end_of(seconds: NDArray[np.float64], free_in: NDArray[np.float64], slot_of: NDArray[np.int64]) -> float:
    load = free_in.copy()
    np.add.at(load, slot_of, seconds[np.arange(len(seconds)), slot_of])
    return float(load.max())


def unequal(tasks: int, slots: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    random = np.random.default_rng(seed)
    seconds = random.uniform(1, 5, (tasks, 1)) * random.uniform(1, 3, slots)
    return seconds, random.uniform(0, 4, slots)


def test_the_last_end_is_hardly_later_than_the_best_of_all() -> None:
    excess = []
    for seed in range(20):
        seconds, free_in = unequal(6, 3, seed)
        best = min(end_of(seconds, free_in, np.array(ways)) for ways in product(range(3), repeat=6))
        excess.append(end_of(seconds, free_in, assign_lpt(seconds, free_in)) / best - 1)
    assert min(excess) >= 0
    assert np.mean(excess) < 0.01
    assert max(excess) < 0.1


def test_no_task_lands_where_it_cannot_run() -> None:
    seconds, free_in = unequal(30, 4, seed=0)
    seconds[::2, 1:] = np.inf
    slot_of = assign_lpt(seconds, free_in)
    assert np.isfinite(seconds[np.arange(30), slot_of]).all()
    assert (slot_of[::2] == 0).all()


def test_nothing_to_deal() -> None:
    assert assign_lpt(np.empty((0, 2)), np.zeros(2)).tolist() == []
