"""The number of Gaussians of a training task before it has run: the law of growth that preflight uses.

Density control (3DGS) adds, every time, the share of Gaussians whose mean screen gradient is above the
threshold. That share can be measured after some twenty iterations. It does not stay: as Gaussians become
smaller and errors shrink, it falls about as fast as the number rises, so what is added each time changes
little. How much that is against the first time depends on how far the first Gaussians are from filling the
picture. Measured on three scenes (a street, a flat, the demo's town) at 128 to 512 pixels and 300 to 1,500
iterations, mean additions until the first opacity reset over those of the first densification:

    ln(pixels / first Gaussians)   0.02   0.5    1.4   1.9   2.1   2.8   3.5
    ratio                          1.2    1.0    1.4   1.6   1.9   2.0   3.2

hence `GROWTH_OFFSET` + `GROWTH_SLOPE` · ln(…). After a reset opacities have to recover first, and 0.2 to
0.5 as many are added. A block adds 1.2 to 1.9 times what Stage I adds, whether a few cameras train it or
all: fewer of them see fewer Gaussians, but with larger mean gradients. The number of Gaussians that follows
was within 30% of the true one in all of these runs; longer ones are an extrapolation. Where Gaussians are
relocated, their number is the budget (`Schedule.budget`).
"""

import math

from panolog.workers.training.schedule import GROWTH_OFFSET, GROWTH_SLOPE, Schedule

_MAX_SHARE = 0.5  # of all Gaussians, at one time: no measured share was above 0.45
_AFTER_RESET = 0.35
_REFINED = 1.4  # additions of a block over those of Stage I

Period = tuple[int, int]  # iterations, and the scene Gaussians during them


def additions(points: int, share: float, pixels: int) -> float:
    """Gaussians that Stage I adds each time, on average, until the first opacity reset.

    Args: points, the Gaussians it starts with; share of them whose mean gradient is above the threshold in
    the first iterations; pixels of one panorama.
    """
    return share * points * (GROWTH_OFFSET + GROWTH_SLOPE * math.log(max(1.0, pixels / max(points, 1))))


def population(start: int, added: float, pixels: int, schedule: Schedule, filled: int = 0) -> list[Period]:
    """The number of scene Gaussians over a task, sky not counted; the iterations add up to the task's.

    Args: start, the points or Gaussians that it starts from; added, `additions` of the scene; pixels of one
    panorama; filled, how many there are at its begin, if more (`Schedule.first`).
    """
    relocates = schedule.config.densify.method == "relocate"
    first = added * (_REFINED if schedule.refine else 1.0)
    rate = first
    periods: list[Period] = []
    count, since = max(start, filled), 0
    for iteration in schedule.turns():
        if schedule.densifies(iteration):
            periods.append((iteration - since, count))
            since = iteration
            if relocates:
                count = max(count, schedule.budget(iteration, start, pixels))
                continue
            grown = count + int(min(rate, _MAX_SHARE * count))
            count = max(count, schedule.capped(grown))
        if schedule.resets(iteration):
            rate = _AFTER_RESET * first
    return [*periods, (schedule.iterations - since, count)]
