"""A few iterations of a job, to learn what the machine that will do it makes of them.

Some iterations with the Gaussians that training starts with, some after splitting them to the number that it
may come to: the two give time and memory per Gaussian. Splitting halves footprints as densification does, so
that these iterations cost what those of a trained model cost (measured: within a tenth).
"""

import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.renderer.process import prepare
from panolog.renderer.render import encode_png, render_panorama
from panolog.scene.images import PanoramaCache, load_view, view_bytes
from panolog.scene.model import Scene
from panolog.scene.random_streams import generator
from panolog.workers.events import Calibration, Sample
from panolog.workers.growth import additions, population
from panolog.workers.meter import forget_peaks, host_peak, memory_in_use
from panolog.workers.metrics import load_lpips, measure
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import CALIBRATE, TaskId
from panolog.workers.training.config import SHConfig, TrainConfig
from panolog.workers.training.densify import densify
from panolog.workers.training.trainer import Trainer, TrainSpec

_VIEWS = 24  # panoramas looked at, at most; gradients are means over views
_STEPS = 25  # iterations for the first sample and the gradients, at most: an interval of densification
_GROWN_STEPS = 8  # iterations for the second
_WARM = 2  # iterations that are not timed: memory is taken for the first time
_DECODING = 0.5  # seconds that decoding may take, for two panoramas at least
_IMAGES = 1 / 8  # of the image cache, for two panoramas at least
_STRIP = 64  # rows of a panorama
_SPLIT = 1e-9  # percent_dense at which everything that grows is split, nothing cloned


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrateSpec(TaskSpec):
    """Tries a job, for so many seconds."""

    task: TaskId = CALIBRATE
    iterations: int  # of the run
    config: TrainConfig
    seed: int
    seconds: float  # for iterations; at least `_WARM` + 1 are made with each model
    most: int  # Gaussians that the second model may have, sky included

    def run(self) -> Iterator[Calibration]:
        """`calibrate`."""
        yield calibrate(self)


def calibrate(spec: CalibrateSpec) -> Calibration:
    """What the iterations have measured. Raises as `training.trainer.train`."""
    scene = spec.scene.load()
    decode = _decoding(spec, scene)
    views = _views(spec, scene, decode)
    # all degrees at once: after a tenth of a run they are in use
    config = spec.config.model_copy(update={"sh": SHConfig(degree=spec.config.sh.degree, every=1)})
    trial = TrainSpec(
        task=spec.task,
        scene=spec.scene,
        views=views,
        width=spec.width,
        iterations=spec.iterations,
        config=config,
        seed=spec.seed,
        device=spec.device,
        locate=spec.locate,
    )
    each = view_bytes(scene.panoramas[views[0]], spec.width)
    begun = time.monotonic()
    with PanoramaCache(scene, views, spec.width, len(views) * each, spec.locate) as cache:
        trainer = Trainer(trial, scene, cache)
        trainer.begin()
        begin = time.monotonic() - begun
        cache.prefetch(views)
        initial = _sample(trainer, views, _STEPS, spec.seconds / 2)
        share = _share(trainer)
        _grow(trainer, _target(spec, trainer, share, initial.seconds))
        grown = _sample(trainer, views, _GROWN_STEPS, spec.seconds / 2)
        single = _single(trainer, views, grown)
        look = _look(trainer, cache, views[0])
    return Calibration(
        spec.width,
        torch.get_num_threads(),
        len(views) * each,
        begin,
        decode,
        share,
        initial,
        grown,
        single,
        look,
    )


def _decoding(spec: CalibrateSpec, scene: Scene) -> float:
    """Seconds to decode one panorama."""
    row = scene.train[0]
    began = time.monotonic()
    load_view(scene.panoramas[row], row, spec.width, spec.locate)
    return time.monotonic() - began


def _views(spec: CalibrateSpec, scene: Scene, decode: float) -> tuple[int, ...]:
    """Training panoramas, evenly chosen, as many as time and memory allow."""
    train = scene.train
    memory = spec.config.cache.memory * 2**30 * _IMAGES
    each = view_bytes(scene.panoramas[train[0]], spec.width)
    count = min(_VIEWS, int(_DECODING / decode), int(memory / each))
    rows = np.linspace(0, len(train) - 1, max(2, min(count, len(train)))).astype(int)
    return tuple(train[row] for row in dict.fromkeys(rows.tolist()))


def _sample(trainer: Trainer, views: Sequence[int], most: int, seconds: float) -> Sample:
    """What iterations cost now: some, for about so long."""
    forget_peaks(trainer.spec.device)
    took: list[float] = []
    ends = time.monotonic() + seconds
    while len(took) < most and (len(took) <= _WARM or time.monotonic() < ends):
        took.append(_iterate(trainer, views))
    median = statistics.median(took[max(_WARM, len(took) // 2) :])  # transparent at first, all are slower
    cuda = trainer.spec.device != "cpu"
    device = memory_in_use(trainer.spec.device) if cuda else 0
    return Sample(len(trainer.trainee.gaussians), median, host_peak(), device)


def _iterate(trainer: Trainer, views: Sequence[int]) -> float:
    """One iteration; its seconds, without those of decoding. Iterations after the last repeat the last."""
    trainer.iteration = min(trainer.iteration + 1, trainer.spec.iterations)
    view = trainer.cache.get(views[trainer.iteration % len(views)])
    began = time.monotonic()
    trainer.step(trainer.iteration, view)  # waits for the device: it looks at the loss
    return time.monotonic() - began


def _share(trainer: Trainer) -> float:
    """Of the scene Gaussians, those that would be densified."""
    mean = trainer.statistics.mean()
    return float((mean >= trainer.spec.config.densify.gradient).float().mean()) if len(mean) else 0.0


def _target(spec: CalibrateSpec, trainer: Trainer, share: float, seconds: float) -> int:
    """Scene Gaussians that a block may come to at its end, as far as they can be tried here.

    Args: seconds of an iteration now.
    """
    gaussians = trainer.trainee.gaussians
    start = len(gaussians) - gaussians.sky
    added = additions(start, share, spec.width * (spec.width // 2))
    coarse = population(start, added, trainer.schedule)[-1][1]
    block = population(coarse, added, replace(trainer.schedule, refine=True))[-1][1]
    affordable = int(spec.seconds / ((_WARM + 1) * seconds) * len(gaussians))
    return max(start, min(block, min(spec.most, affordable) - gaussians.sky))


def _grow(trainer: Trainer, target: int) -> None:
    """Splits scene Gaussians, chosen at random, until there are so many."""
    spec = trainer.spec
    config = spec.config.densify.model_copy(update={"percent_dense": _SPLIT, "max_gaussians": 0})
    random = generator(spec.seed, str(spec.task), "grow", 0)
    trainer.forget_statistics()
    while (count := len(trainer.statistics.views)) and count < target:
        chosen = torch.from_numpy(random.permutation(count)[: target - count])
        trainer.statistics.gradient[chosen.to(spec.device)] = torch.inf
        densify(trainer.trainee, trainer.statistics, config, trainer.schedule.extent, random)
        trainer.forget_statistics()


def _single(trainer: Trainer, views: Sequence[int], grown: Sample) -> float:
    """Seconds of an iteration on one thread: what tasks have that share a machine's cores."""
    threads = torch.get_num_threads()
    if threads == 1 or trainer.spec.device != "cpu":
        return grown.seconds
    prepare(1)
    seconds = statistics.median(_iterate(trainer, views) for _ in range(_WARM + 1))
    prepare(threads)
    return seconds


def _look(trainer: Trainer, cache: PanoramaCache, row: int) -> float:
    """Seconds to render, measure and encode one panorama, as the evaluation does."""
    panorama, view = trainer.scene.panoramas[row], cache.get(row)
    began = time.monotonic()
    gaussians = trainer.trainee.gaussians
    image = render_panorama(
        gaussians, panorama.rotation, panorama.translation, trainer.spec.width, trainer.near
    )
    mask = None if view.mask is None else view.mask.numpy()
    truth = view.image.numpy()
    measure(image, truth, mask)
    encode_png(image)
    seconds = time.monotonic() - began
    return seconds + _lpips_seconds(image, truth, trainer.spec.device)


def _lpips_seconds(render: NDArray[np.uint8], truth: NDArray[np.uint8], device: str) -> float:
    """Seconds of LPIPS, where it is installed: a network of convolutions, so a strip tells of the whole."""
    lpips, _ = load_lpips(device)
    if lpips is None:
        return 0.0
    rows = min(len(render), _STRIP)
    lpips(render[:rows], truth[:rows])  # the first call also prepares
    began = time.monotonic()
    lpips(render[:rows], truth[:rows])
    return (time.monotonic() - began) * len(render) / rows
