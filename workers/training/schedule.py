"""The schedule of a training task: pure functions of the iteration.

The config states schedules for 30,000 iterations. Points in time scale with the length of the run; intervals
do too, but have floors, since a Gaussian needs the same number of steps to react in a shorter run.
Iterations count from 1 to `iterations`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

from panolog.scene.random_streams import generator
from panolog.workers.training.config import DensifyConfig, TrainConfig

FULL_RUN = 30_000  # iterations that the config's schedules are stated for
SHORT_RUN = 1_500  # iterations up to which the budget of Gaussians is `densify.growth`'s
AVERAGED = 32  # models in an average, about: 13 were as good as 62
GROWTH_OFFSET, GROWTH_SLOPE = 0.85, 0.5  # by the pixels of each Gaussian, measured: workers/growth_law.py


@lru_cache(maxsize=4)
def epoch(seed: int, task: str, views: tuple[int, ...], number: int) -> tuple[int, ...]:
    """The views in the order of one epoch: every epoch is a permutation of all of them."""
    return tuple(views[i] for i in generator(seed, task, "views", number).permutation(len(views)))


def order(seed: int, task: str, views: tuple[int, ...], iteration: int) -> Iterator[int]:
    """The views of an epoch from that of an iteration on, cyclically: the first sound one is trained on.

    So the view is a function of the iteration and of which files are damaged, with or without a resume.
    """
    number, at = divmod(iteration - 1, len(views))
    epoch_order = epoch(seed, task, views, number)
    yield from epoch_order[at:]
    yield from epoch_order[:at]


@dataclass(frozen=True)
class Schedule:
    """Events, weights and rates of one training task by iteration."""

    config: TrainConfig
    iterations: int
    extent: float  # world units, `initialise.camera_extent`
    refine: bool  # Stage II

    @cached_property
    def densify(self) -> DensifyConfig:
        """How Gaussians densify, in Stage II with what `stage2` changes."""
        config, stage2 = self.config.densify, self.config.stage2
        if not self.refine:
            return config
        decay = config.opacity_decay * stage2.opacity_decay
        return config.model_copy(update={"growth": config.growth * stage2.growth, "opacity_decay": decay})

    def point(self, iteration: int) -> float:
        """A point in time of the full run, in iterations of this one."""
        return iteration * self.iterations / FULL_RUN

    def interval(self, every: int, floor: int) -> int:
        """An interval of the full run, in iterations of this one, at least `floor`."""
        return max(round(self.point(every)), floor)

    def collects(self, iteration: int) -> bool:
        """Whether this iteration's screen gradients count for densification (3DGS)."""
        return iteration < self.point(self.config.densify.until)

    def ends_interval(self, iteration: int) -> bool:
        """Whether this iteration ends an interval of densification, also before its start and after it."""
        return iteration % self.interval(self.config.densify.every, self.config.densify.every_floor) == 0

    def densifies(self, iteration: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this iteration (3DGS)."""
        started = iteration > self.point(self.config.densify.start) and not self.recovers(iteration)
        return started and self.collects(iteration) and self.ends_interval(iteration)

    def prunes_large(self, iteration: int) -> bool:
        """Whether densification removes large Gaussians: when the first reset has been due (3DGS)."""
        reset, scale = self.config.reset, self.config.densify.prune_scale
        return scale > 0 and iteration > self.interval(reset.every, reset.every_floor)

    def turns(self) -> list[int]:
        """The iterations after which Gaussians may densify or opacities be reset, and no others."""
        densify, reset = self.config.densify, self.config.reset
        every = (self.interval(group.every, group.every_floor) for group in (densify, reset))
        return sorted({turn for each in every for turn in range(each, self.iterations + 1, each)})

    def recovers(self, iteration: int) -> bool:
        """Whether opacities still recover from a reset: those that are low now need not stay so."""
        reset = self.config.reset
        since = iteration % self.interval(reset.every, reset.every_floor)
        return 0 < since < min(iteration, reset.recovery) and self.resets(iteration - since)

    def resets(self, iteration: int) -> bool:
        """Whether opacities are reset after this iteration: while densifying, never near the end (app. D).

        They never are where Gaussians are relocated.
        """
        reset = self.config.reset
        if self.config.densify.method == "relocate":
            return False
        due = iteration % self.interval(reset.every, reset.every_floor) == 0
        return due and self.collects(iteration) and iteration <= (1 - reset.quiet) * self.iterations

    def changes(self, iteration: int) -> bool:
        """Whether rows of Gaussians or opacities may change after this iteration (`relocate.Growth`)."""
        return self.ends_interval(iteration) or self.resets(iteration) or iteration == self.iterations

    def averages(self, iteration: int) -> bool:
        """Whether the model after this iteration counts in the average: some do, and the last."""
        span = self.iterations * self.config.optimizer.average
        left = self.iterations - iteration
        return left < span and left % max(1, int(span / AVERAGED)) == 0

    @property
    def drops_unrisen(self) -> bool:
        """Whether what no view has raised since the last reset is removed at the end, if there was one."""
        reset = self.config.reset
        return reset.unrisen == "removed" and self.resets(self.interval(reset.every, reset.every_floor))

    def budget(self, iteration: int, start: int, pixels: int) -> int:
        """How many Gaussians there are after this iteration where they are relocated: rising evenly.

        Args: start, how many there were before the first iteration; pixels of one panorama.
        """
        densify = self.densify
        length = 1.0 if self.refine else min(max(self.iterations, SHORT_RUN), FULL_RUN) / SHORT_RUN
        factor = GROWTH_OFFSET + GROWTH_SLOPE * math.log(max(1.0, pixels / max(start, 1)))
        factor *= densify.growth * length**densify.long_runs
        first, last = self.point(densify.start), min(self.point(densify.until), self.iterations)
        ends = first + densify.filled * (last - first)
        share = min(max((iteration - first) / max(ends - first, 1.0), 0.0), 1.0)
        count = start + int(start * factor * share)
        return max(start, self.capped(count))

    def capped(self, count: int) -> int:
        """The number `count` of Gaussians, or `densify.max_gaussians`, the cap of a task, if that is less."""
        return min(count, self.densify.max_gaussians or count)

    def first(self, points: int, pixels: int) -> int:
        """How many scene Gaussians Stage I begins with, if depth images have as many points.

        Args: points of the sparse cloud; pixels of one panorama.
        """
        config = self.config.depth
        part = config.points if config.w0 > 0 else 0.0
        return max(points, int(part * self.budget(self.iterations, points, pixels)))

    def position(self, iteration: int) -> float:
        """The rate of means of a full run, in `optimizer.unit`: it decays exponentially (3DGS)."""
        rates, share = self.config.optimizer, iteration / self.iterations
        first = rates.position * (self.config.stage2.position if self.refine else 1)
        if first == 0:
            return 0.0
        return math.exp((1 - share) * math.log(first) + share * math.log(rates.position_final))

    def opacity(self, iteration: int) -> float:
        """The rate of logit opacities of Stage I, which decays exponentially where a last one is set.

        The last rate is larger in a shorter run, as those of positions are, but not more than the first.
        """
        rates = self.config.optimizer
        if rates.opacity_final is None or rates.opacity == 0:
            return rates.opacity
        last = min(rates.opacity, self.length**2 * rates.opacity_final)
        return self._decayed(rates.opacity, last, iteration)

    def cooling(self, iteration: int) -> float:
        """The rate of positions over the first one of Stage I, at most 1."""
        first = self.config.optimizer.position
        return self.position(iteration) / first if first > 0 else 0.0

    def sh_degree(self, iteration: int) -> int:
        """Degrees of spherical harmonics in use: growing in Stage I (3DGS), all of them in Stage II."""
        degree = self.config.sh.degree
        if self.refine:
            return degree
        return min(degree, int(iteration / self.point(self.config.sh.every)))

    def depth_weight(self, iteration: int) -> float:
        """w(t) = w_0 (w_T / w_0)^(t/T) of app. C; 0 if w_0 is 0."""
        depth = self.config.depth
        if depth.w0 == 0:
            return 0.0
        return self._decayed(depth.w0, depth.wT, iteration)

    def _decayed(self, first: float, last: float, iteration: int) -> float:
        """A value that decays exponentially from the first at iteration 0 to the last at the end."""
        return float(first * (last / first) ** (iteration / self.iterations))

    def sizes(self, width: int) -> tuple[float, float, float]:
        """The bounds of scales, as `ModelState.bound` takes them, of panoramas `width` pixels wide."""
        rates, sky = self.config.optimizer, self.config.sky
        number = 0 if self.refine or not sky.sharp else sky.number(width * (width // 2))
        return rates.least_pixels * 2 * math.pi / width, rates.largest, sky.sigma(number) if number else 0.0

    @property
    def length(self) -> float:
        """By what the rates of shapes are multiplied in a run that is shorter than a full one."""
        return float(max(1.0, FULL_RUN / self.iterations) ** self.config.optimizer.short_runs)

    def rates(self, iteration: int) -> dict[str, float]:
        """Learning rates by parameter; those of means and of SH of higher degrees in `ModelState.units`."""
        rates, rate = self.config.optimizer, self.config.stage2.rate if self.refine else 1.0
        shapes, colors = rate * self.length, rate * math.sqrt(self.length)
        unit = 1.0 if rates.unit == "distance" else self.extent
        return {
            "means": self.length**2 * self.position(iteration) * unit,
            "quats": shapes * rates.rotation,
            "scales": shapes * rates.scale * (self.config.stage2.scale if self.refine else 1.0),
            "opacities": self.opacity(iteration) * rate,
            "sh0": colors * rates.sh0,
            "shN": colors * rates.shN,
        }
