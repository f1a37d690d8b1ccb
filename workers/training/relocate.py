"""Growth to a budget: live Gaussians are copied in place of transparent ones, and up to a number.

After "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024): sources are drawn in
proportion to a weight, copies share opacity and size of their source so that the picture stays, and faint
Gaussians receive noise. Opacities decay a little instead of being reset ("Revising Densification in Gaussian
Splatting", Rota Bulò et al. 2024). All of it happens when Gaussians densify: other iterations cost no more.

Opacities and sums are computed by numpy on one thread: the rounding of torch depends on the threads.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import comb
from typing_extensions import assert_never

from panolog.partition.cells import Volume
from panolog.scene.gaussians import Gaussians, logit
from panolog.scene.random_streams import generator
from panolog.workers.training.config import DensifyConfig
from panolog.workers.training.densify import (
    Statistics,
    densify,
    drop_large,
    drop_unrisen,
    opacities_of,
    reset_opacities,
    rotate,
    stretch_apart,
    write_opacities,
)
from panolog.workers.training.exterior import inside
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.schedule import Schedule

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

MOST = 50  # parts of one Gaussian at one time: the tests of `shares` go so far
_SLOPE, _FAINT = 100.0, 0.005  # k and t of the noise in the MCMC paper: only what is nearly transparent moves
_LEAST_OPACITY = 1e-6
_MOST_WEIGHT = 1e30  # so that the sum of all is finite
_LEAST_NOISE = 1e-3  # of the largest; below it nothing moves


@dataclass(frozen=True, eq=False)
class Place:
    """Where a task may grow."""

    cell: Volume | None  # of a block
    start: int  # what the budget follows: `Trainer.start`
    pixels: int  # of a panorama


@dataclass(frozen=True, eq=False)
class Room:
    """How many Gaussians there may be, and which take part. (S,) rows are those of the scene Gaussians."""

    target: int  # of those inside, after this time
    inside: NDArray[np.bool_]  # (S,) those that are copied, decay and move; the others are only removed
    cooling: float  # share of the noise that is left, 1 at the first iteration


class Grown(NamedTuple):
    """What has happened to the rows of a model."""

    statistics: Statistics  # those that continue: the same where no row has changed
    invalid: int  # Gaussians that were not finite and are removed


@dataclass(frozen=True, eq=False)
class Growth:
    """Which Gaussians there are, from iteration to iteration: of a trainer's task, and of `workers.loop`."""

    schedule: Schedule
    place: Place
    seed: int
    task: str  # whose random numbers these are

    def after(self, state: ModelState, statistics: Statistics, iteration: int) -> Grown:
        """What is due after a step: drop invalid Gaussians, densify, reset opacities, at last drop haze.

        Only `schedule.changes` iterations change anything.
        """
        schedule, reset = self.schedule, self.schedule.config.reset
        last, invalid = iteration == schedule.iterations, 0
        if (schedule.ends_interval(iteration) or last) and (invalid := state.drop_invalid()):
            statistics = statistics.anew(state.gaussians.scene.stop)
        if schedule.densifies(iteration):
            self._grow(state, statistics, iteration)
            statistics = statistics.anew(state.gaussians.scene.stop)
        if schedule.resets(iteration):
            reset_opacities(state, reset.opacity)
        if last and schedule.drops_unrisen:
            drop_unrisen(state, reset.opacity)
            statistics = statistics.anew(state.gaussians.scene.stop)
        return Grown(statistics, invalid)

    def _grow(self, state: ModelState, statistics: Statistics, iteration: int) -> None:
        """Densify, by the method of the settings."""
        schedule, place, config = self.schedule, self.place, self.schedule.densify
        random = generator(self.seed, self.task, "split", iteration)
        match config.method:
            case "clone-split":
                densify(state, statistics, config, schedule.extent, random)
                if schedule.prunes_large(iteration):
                    drop_large(state, config.prune_scale * schedule.extent)
            case "relocate":
                target = schedule.budget(iteration, place.start, place.pixels)
                room = Room(target, inside(state.gaussians, place.cell), schedule.cooling(iteration))
                relocate(state, statistics, config, room, random)
            case _:
                assert_never(config.method)


def relocate(
    state: ModelState, statistics: Statistics, config: DensifyConfig, room: Room, random: np.random.Generator
) -> None:
    """Remove transparent scene Gaussians, and copy live ones until there are `room.target` inside.

    Copies start with zero moments. The rows of the statistics no longer match afterwards. Nothing is copied
    more than `MOST` times, or where nothing inside is alive.
    """
    gaussians = state.gaussians
    scene = gaussians.scene
    dead = (gaussians.opacities[scene] < logit(config.prune_opacity)).cpu().numpy()
    live = room.inside & ~dead
    opacities = opacities_of(gaussians, scene)
    weights = opacities if config.weight == "opacity" else statistics.mean().cpu().numpy().astype(np.float64)
    copies = _drawn(np.where(live, weights, 0.0), room.target - int(live.sum()), float(random.random()))
    rows = copies.nonzero()[0]
    kept, sky = (~dead).nonzero()[0], np.arange(scene.stop, len(gaussians))
    source = np.concatenate([kept, np.repeat(rows, copies[rows]), sky])
    new = np.zeros(len(source), np.bool_)
    new[len(kept) : len(source) - len(sky)] = True
    device = gaussians.means.device
    state.rearrange(torch.from_numpy(source).to(device), torch.from_numpy(new).to(device), len(sky))
    shared = np.concatenate([(np.cumsum(~dead) - 1)[rows], new.nonzero()[0]])  # rows of sources, then copies
    parts = np.concatenate([copies[rows], np.repeat(copies[rows], copies[rows])]) + 1
    _share(state.gaussians, shared, parts, config.long_axis, len(rows))
    inside = np.concatenate([room.inside[kept], np.ones(int(new.sum()), np.bool_)])
    _decay(state.gaussians, inside, config)
    _shake(state.gaussians, inside, config.noise * room.cooling, random)


def _drawn(weights: Floats, count: int, start: float) -> Counts:
    """(S,) how often each is drawn: `count` times in all, in proportion to its weight to within one.

    Systematic sampling: `count` marks at equal distances, the first at `start` in [0, 1), on the line of all
    weights. None is drawn more than `MOST` - 1 times.
    """
    ends = np.cumsum(np.nan_to_num(weights, nan=0.0, posinf=_MOST_WEIGHT).clip(max=_MOST_WEIGHT))
    if count <= 0 or not len(ends) or not ends[-1] > 0:
        return np.zeros(len(weights), np.int64)
    before = np.ceil(ends / ends[-1] * count - start).clip(0, count).astype(np.int64)
    before[ends == ends[-1]] = count
    return np.asarray(np.minimum(np.diff(before, prepend=0), MOST - 1))


def shares(opacities: Floats, parts: Counts) -> tuple[Floats, Floats]:
    """Opacity and factor of the size of n copies in one place that look as one Gaussian (eq. 9 of MCMC).

    o' = 1 − (1 − o)^(1/n); σ'/σ = o / Σ_m C(n, m) (−1)^(m+1) o'^m / √m, m from 1 to n.

    Args: opacities (M,) in (0, 1); parts (M,) n from 1 to `MOST`.
    """
    each = 1 - (1 - opacities) ** (1 / parts)
    total = np.zeros(len(parts))
    for m in range(1, int(parts.max(initial=0)) + 1):
        total -= comb(parts, m) * (-each) ** m / np.sqrt(m)
    return each, opacities / total


def _share(gaussians: Gaussians, rows: Counts, parts: Counts, long_axis: bool, sources: int) -> None:
    """Sources and their copies, in equal rows of parameters, become parts of what the sources were.

    Args: rows (M,) of `sources` sources and then of all copies, in the order of their sources; parts (M,)
    into how many each one's source was divided.
    """
    if not len(rows):
        return
    device = gaussians.means.device
    at = torch.from_numpy(rows).to(device)
    opacities = opacities_of(gaussians, at)
    if long_axis:
        first = np.cumsum(parts[:sources] - 1) - (parts[:sources] - 1)  # copies before those of each source
        of_copies = np.arange(len(rows) - sources) - np.repeat(first, parts[:sources] - 1) + 1
        number = np.concatenate([np.zeros(sources, np.int64), of_copies])
        opacities *= stretch_apart(gaussians, at, number, parts)
    else:
        opacities, factor = shares(opacities, parts)
        gaussians.scales[at] += torch.from_numpy(np.log(factor).astype(np.float32)).to(device)[:, None]
    write_opacities(gaussians, at, opacities)


def _decay(gaussians: Gaussians, inside: NDArray[np.bool_], config: DensifyConfig) -> None:
    """Opacities of those inside become a little less: what no view holds up vanishes."""
    rows = torch.from_numpy(inside.nonzero()[0]).to(gaussians.means.device)
    if config.opacity_decay > 0:
        opacities = opacities_of(gaussians, rows)
        write_opacities(gaussians, rows, np.maximum(opacities - config.opacity_decay, _LEAST_OPACITY))


def _shake(
    gaussians: Gaussians, inside: NDArray[np.bool_], strength: float, random: np.random.Generator
) -> None:
    """Noise on the positions of faint Gaussians, along each axis as its variance (the MCMC paper).

    Its largest standard deviation is `strength` times that of the Gaussian: free of the unit of length.
    """
    faintness = 1 / (1 + np.exp(_SLOPE * (opacities_of(gaussians, gaussians.scene) - _FAINT)))
    rows = (inside & (faintness > _LEAST_NOISE)).nonzero()[0]
    if strength == 0 or not len(rows):
        return
    noise = random.standard_normal((len(rows), 3), np.float32) * faintness[rows, None].astype(np.float32)
    device = gaussians.means.device
    at = torch.from_numpy(rows).to(device)
    scales = gaussians.scales[at]
    size = torch.exp(2 * scales - scales.amax(1, keepdim=True))
    gaussians.means[at] += rotate(gaussians.quats[at], strength * size * torch.from_numpy(noise).to(device))
