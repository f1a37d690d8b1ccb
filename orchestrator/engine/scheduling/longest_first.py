"""Assigns tasks of known length to slots so that the last ends as soon as possible.

Longest first, each to the slot on which it ends first (Graham's LPT); then, as long as that helps, the slot
that ends last gives a task away or swaps one for another.
"""

import numpy as np
from numpy.typing import NDArray

_STEPS = 500  # moves and swaps at most; recorded runs needed six
_GAIN = 1 - 1e-9  # what a step must leave of the longest load, at most: rounding is no gain

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def assign_lpt(seconds: Floats, free_in: Floats) -> Ints:
    """The slot of each task, (T,).

    Args: seconds (T, S) of each task on each slot, inf where it cannot run; every task can run on some slot.
    free_in (S,) seconds until a slot is free. Of slots that are equally good, the first is taken.
    """
    load = free_in.copy()
    slot_of = np.zeros(len(seconds), np.int64)
    shortest = seconds.min(axis=1, initial=np.inf)
    for task in np.argsort(-shortest, kind="stable"):
        slot = int(np.argmin(load + seconds[task]))
        slot_of[task] = slot
        load[slot] += seconds[task, slot]
    for _ in range(_STEPS):
        if not _improve(seconds, slot_of, load):
            break
    return slot_of


def _improve(seconds: Floats, slot_of: Ints, load: Floats) -> bool:
    """Makes the best move or swap with the slot that ends last, in place; False if none is better."""
    last = int(load.argmax())
    given, others = np.flatnonzero(slot_of == last), np.flatnonzero(slot_of != last)
    if not len(given):
        return False
    without = load[last] - seconds[given, last]  # (G,)
    moved = np.maximum(without[:, None], load + seconds[given])  # (G, S) the later end of the two slots
    moved[:, last] = np.inf
    slots = slot_of[others]  # (O,)
    swapped = np.maximum(
        without[:, None] + seconds[others, last],
        load[slots] - seconds[others, slots] + seconds[given][:, slots],
    )  # (G, O) likewise
    best = min(moved.min(), swapped.min(initial=np.inf))
    if best >= load[last] * _GAIN:
        return False
    if best == moved.min():
        row, slot = np.unravel_index(moved.argmin(), moved.shape)
        _move(int(given[row]), int(slot), seconds, slot_of, load)
    else:
        row, column = np.unravel_index(swapped.argmin(), swapped.shape)
        _move(int(given[row]), int(slots[column]), seconds, slot_of, load)
        _move(int(others[column]), last, seconds, slot_of, load)
    return True


def _move(task: int, slot: int, seconds: Floats, slot_of: Ints, load: Floats) -> None:
    load[slot_of[task]] -= seconds[task, slot_of[task]]
    load[slot] += seconds[task, slot]
    slot_of[task] = slot
