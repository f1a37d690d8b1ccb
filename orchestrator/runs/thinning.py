"""What is kept of what a run repeats, so that days of it stay small.

Of each task the first `DENSE` records of progress are stored, later ones at intervals that grow by `GROWTH`
with each: however often a task is repeated, what is stored depends on the time alone. Of previews the first,
the latest and at most `PREVIEWS` in all are kept, evenly spaced.
"""

import math
from collections.abc import Sequence

DENSE = 100  # records of progress of a task that are stored without regard to their time
GROWTH = 1.02  # of the interval with each of the later ones, which begins at a second
PREVIEWS = 16  # files of a task at most
ROW = 1_300  # bytes of a stored record of progress with its rows of metrics and their indexes


def interval(stored: int) -> float:
    """Seconds from the last stored progress of a task until the next one is stored, if so many are."""
    return 0.0 if stored < DENSE else float(GROWTH ** (stored - DENSE))


def most_stored(seconds: float) -> int:
    """How many records of progress of a task at most are stored in so many seconds, its end included."""
    return DENSE + 1 + math.ceil(math.log1p(max(0.0, seconds) * (GROWTH - 1)) / math.log(GROWTH))


def surplus(iterations: Sequence[int], latest: int) -> int | None:
    """The preview to remove after `latest` was written: the one that its neighbours miss least.

    Args: iterations, of all previews of a task, ascending. Returns None while there are few enough.
    """
    if len(iterations) <= PREVIEWS:
        return None
    gaps = zip(iterations, iterations[1:-1], iterations[2:], strict=False)
    _, least = min((after - before, middle) for before, middle, after in gaps if middle != latest)
    return least
