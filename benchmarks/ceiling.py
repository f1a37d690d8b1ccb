"""How many pairs per second this processor could do at most: their arithmetic, all of it in registers."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from panolog.renderer import _core

SECONDS = 0.2  # of each loop


@dataclass(frozen=True)
class Ceiling:
    """Pairs per second of all threads together, with neither memory nor branches in the way."""

    forward: float
    backward: float


def ceiling(threads: int) -> Ceiling:
    """Measured now, so that what else the machine does counts alike here and beside it."""
    return Ceiling(_together(threads, backward=False), _together(threads, backward=True))


def _together(threads: int, *, backward: bool) -> float:
    """The sum over loops that run side by side: they do not hold Python's lock."""
    with ThreadPoolExecutor(threads) as pool:
        loops = [pool.submit(_core.ceiling, backward, SECONDS) for _ in range(threads)]
        return sum(loop.result() for loop in loops)
