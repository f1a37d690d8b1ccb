"""A few iterations of a job, to measure its time and memory on the machine that will run it.

Some iterations with the Gaussians that training starts with, some after splitting them to the number that it
may reach: the two give time and memory per Gaussian. Splitting halves footprints as densification does, so
these iterations cost as much as those of a trained model (measured: within a tenth).
"""

import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from panolog.renderer import ops
from panolog.scene.errors import SceneError
from panolog.scene.images import View, load_view, view_bytes
from panolog.scene.model import Scene
from panolog.scene.random_streams import generator
from panolog.workers.evaluation import evaluate_view
from panolog.workers.events import Calibration, IterationCost
from panolog.workers.growth_law import additions, population
from panolog.workers.meter import host_peak, memory_in_use, reset_peaks
from panolog.workers.metrics import load_lpips
from panolog.workers.sound_views import open_cache
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import CALIBRATE, Progress, TaskId
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.densify import densify
from panolog.workers.training.trainer import Trainer, TrainSpec

_VIEWS = 24  # panoramas, at most; gradients are means over views
_STEPS = 25  # iterations with the initial model, at most: an interval of densification
_GROWN_STEPS = 8  # iterations with the grown model, at most
_WARM_UP = 2  # iterations that are not timed: the first ones allocate memory
_DECODE_SECONDS = 0.5  # to decode panoramas, at least two
_CACHE_SHARE = 1 / 8  # of the image cache, at least two panoramas
_STRIP = 64  # rows of a panorama
_PARTS = 5  # of its work
_SPLIT_ALL = 1e-9  # percent_dense at which every selected Gaussian is split, none cloned


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrateSpec(TaskSpec):
    """Measures iterations of a job for a number of seconds."""

    task: TaskId = CALIBRATE
    iterations: int  # of the run
    config: TrainConfig
    seed: int
    seconds: float  # for iterations; at least `_WARM_UP` + 1 are made with each model
    most: int  # Gaussians that the second model may have, sky included

    def run(self) -> Iterator[Progress | Calibration]:
        """The measurements, last; before, signs that it works. Raises as `training.trainer.train`."""
        scene = self.scene.load()
        decode = _decode_seconds(self, scene)
        views = _views(self, scene, decode)
        sh = self.config.sh.model_copy(update={"every": 1})  # all degrees at once, as after a part of a run
        config = self.config.model_copy(update={"sh": sh})
        trial = TrainSpec(
            task=self.task,
            scene=self.scene,
            views=views,
            width=self.width,
            iterations=self.iterations,
            config=config,
            seed=self.seed,
            device=self.device,
            locate=self.locate,
        )
        each = view_bytes(scene.panoramas[views[0]], self.width)
        started = time.monotonic()
        with open_cache(self, scene, views, len(views) * each) as cache:
            _require_pixels(scene, [cache.get(row) for row in views])
            trainer = Trainer(trial, scene, cache)
            yield from trainer.begin()
            begin = time.monotonic() - started
            yield Progress(self.task, 1, _PARTS, 0.0)
            cache.prefetch(views)
            initial = _iteration_cost(trainer, views, _STEPS, self.seconds / 2)
            yield Progress(self.task, 2, _PARTS, 0.0)
            share = _densified_share(trainer)
            _grow(trainer, _target(self, trainer, share, initial.seconds))
            grown = _iteration_cost(trainer, views, _GROWN_STEPS, self.seconds / 2)
            yield Progress(self.task, 3, _PARTS, 0.0)
            single = _single_thread_seconds(trainer, views, grown)
            yield Progress(self.task, 4, _PARTS, 0.0)
            evaluation = _evaluation_seconds(trainer, views[0])
        yield Calibration(
            width=self.width,
            threads=ops.threads(),
            images=len(views) * each,
            begin=begin,
            decode=decode,
            share=share,
            initial=initial,
            grown=grown,
            single=single,
            look=evaluation,
        )


def _require_pixels(scene: Scene, views: Sequence[View]) -> None:
    """Raises SceneError if nothing of any of the views is used."""
    if all(view.mask is not None and not bool(view.mask.any()) for view in views):
        raise SceneError(
            f"{scene.root}: the masks leave nothing of {len(views)} panoramas that were looked at: white is"
            " used, black is left out"
        )


def _decode_seconds(spec: CalibrateSpec, scene: Scene) -> float:
    """Seconds to decode one panorama."""
    row = scene.train[0]
    started = time.monotonic()
    load_view(scene.panoramas[row], row, spec.width, spec.locate)
    return time.monotonic() - started


def _views(spec: CalibrateSpec, scene: Scene, decode: float) -> tuple[int, ...]:
    """Training panoramas, evenly chosen, as many as time and memory allow."""
    train = scene.train
    memory = spec.config.cache.memory * 2**30 * _CACHE_SHARE
    each = view_bytes(scene.panoramas[train[0]], spec.width)
    count = min(_VIEWS, int(_DECODE_SECONDS / decode), int(memory / each))
    rows = np.linspace(0, len(train) - 1, max(2, min(count, len(train)))).astype(int)
    return tuple(train[row] for row in dict.fromkeys(rows.tolist()))


def _iteration_cost(trainer: Trainer, views: Sequence[int], most: int, seconds: float) -> IterationCost:
    """The cost of iterations with the current model: at most `most`, for about `seconds`."""
    reset_peaks(trainer.spec.device)
    took: list[float] = []
    ends = time.monotonic() + seconds
    while len(took) < most and (len(took) <= _WARM_UP or time.monotonic() < ends):
        took.append(_iterate(trainer, views))
    # the first iterations are slower: all Gaussians are transparent
    median = statistics.median(took[max(_WARM_UP, len(took) // 2) :])
    cuda = trainer.spec.device != "cpu"
    device = memory_in_use(trainer.spec.device) if cuda else 0
    return IterationCost(len(trainer.state.gaussians), median, host_peak(), device)


def _iterate(trainer: Trainer, views: Sequence[int]) -> float:
    """One iteration; its seconds, without those of decoding. Iterations after the last repeat the last."""
    trainer.iteration = min(trainer.iteration + 1, trainer.spec.iterations)
    view = trainer.cache.get(views[trainer.iteration % len(views)])
    started = time.monotonic()
    trainer.step(trainer.iteration, view)
    trainer.settle()  # waits for the device
    return time.monotonic() - started


def _densified_share(trainer: Trainer) -> float:
    """The share of the scene Gaussians that would be densified."""
    mean = trainer.statistics.mean()
    return float((mean >= trainer.spec.config.densify.gradient).float().mean()) if len(mean) else 0.0


def _target(spec: CalibrateSpec, trainer: Trainer, share: float, seconds: float) -> int:
    """The number of scene Gaussians that a block may reach, limited by memory and time.

    Args: seconds of an iteration of the current model.
    """
    gaussians = trainer.state.gaussians
    start = len(gaussians) - gaussians.sky
    pixels = spec.width * (spec.width // 2)
    added = additions(start, share, pixels)
    coarse = population(trainer.start, added, pixels, trainer.schedule, start)[-1][1]
    block = population(coarse, added, pixels, replace(trainer.schedule, refine=True))[-1][1]
    affordable = int(spec.seconds / ((_WARM_UP + 1) * seconds) * len(gaussians))
    return max(start, min(block, min(spec.most, affordable) - gaussians.sky))


def _grow(trainer: Trainer, target: int) -> None:
    """Splits scene Gaussians, chosen at random, until there are `target`."""
    spec = trainer.spec
    everything = {
        "percent_dense": _SPLIT_ALL,
        "max_gaussians": 0,
        "split_gradient": 0.0,
        "least_opacity": 0.0,
    }
    config = spec.config.densify.model_copy(update=everything)
    random = generator(spec.seed, str(spec.task), "grow", 0)
    trainer.statistics = trainer.statistics.anew(trainer.state.gaussians.scene.stop)
    while (count := len(trainer.statistics.views)) and count < target:
        chosen = torch.from_numpy(random.permutation(count)[: target - count])
        trainer.statistics.gradient[chosen.to(spec.device)] = torch.inf
        densify(trainer.state, trainer.statistics, config, trainer.schedule.extent, random)
        trainer.statistics = trainer.statistics.anew(trainer.state.gaussians.scene.stop)


def _single_thread_seconds(trainer: Trainer, views: Sequence[int], grown: IterationCost) -> float:
    """Seconds of an iteration on one thread, for tasks that share the cores of a machine."""
    threads = ops.threads()
    if threads == 1 or trainer.spec.device != "cpu":
        return grown.seconds
    ops.use_threads(1)
    seconds = statistics.median(_iterate(trainer, views) for _ in range(_WARM_UP + 1))
    ops.use_threads(threads)
    return seconds


def _evaluation_seconds(trainer: Trainer, row: int) -> float:
    """Seconds to render, measure and encode one panorama, as the evaluation does."""
    spec, view = trainer.spec, trainer.cache.get(row)
    started = time.monotonic()
    evaluate_view(trainer.state.gaussians, trainer.scene.panoramas[row], view, spec.width, trainer.near)
    return time.monotonic() - started + _lpips_seconds(spec.width, spec.device)


def _lpips_seconds(width: int, device: str) -> float:
    """Seconds of LPIPS, in both ranges, on one panorama, where it is installed: measured on a strip of it."""
    lpips, _ = load_lpips(device)
    if lpips is None:
        return 0.0
    rows = min(width // 2, _STRIP)
    strip = np.zeros((rows, width, 3), np.uint8)
    lpips(strip, strip)  # the first call also initialises the network
    started = time.monotonic()
    lpips(strip, strip)
    return 2 * (time.monotonic() - started) * (width // 2) / rows
