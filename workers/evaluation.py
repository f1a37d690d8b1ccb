"""Evaluation: the model against panoramas that it has never seen."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

from panolog.renderer.render import encode_png, render_panorama
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache
from panolog.workers.events import Evaluated, Event, LpipsMissing, Progress
from panolog.workers.meter import forget_peaks, host_peak, memory_in_use
from panolog.workers.metrics import load_lpips, measure
from panolog.workers.specs import Source, TaskSpec
from panolog.workers.tasks import EVAL, TaskId

_IMAGE_MEMORY = 2**30  # bytes of decoded panoramas; each one is needed once


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluateSpec(TaskSpec):
    """Renders panoramas with a model and compares them with their photographs."""

    task: TaskId = EVAL
    views: tuple[int, ...]  # rows of scene.panoramas, normally scene.test
    model: Source[Gaussians]
    near: float  # world units below which nothing is drawn, as in training
    crop_bottom: float = 0.0  # fraction of the height left out (the paper: 0.1 for hand-held cameras)

    def run(self) -> Iterator[Event]:
        """`evaluate`."""
        return evaluate(self)


def evaluate(spec: EvaluateSpec) -> Iterator[Event]:
    """Renders and measures each view: one Evaluated and one Progress for each; first, perhaps, LpipsMissing.

    Raises InputError if the PLY or an image cannot be read.
    """
    forget_peaks(spec.device)
    scene, model = spec.scene.load(), spec.model.load().to(spec.device)
    lpips, reason = load_lpips(spec.device)
    if reason:
        yield LpipsMissing(spec.task, reason)
    start = time.monotonic()
    with PanoramaCache(scene, spec.views, spec.width, _IMAGE_MEMORY, spec.locate) as cache:
        for done, row in enumerate(spec.views, 1):
            cache.prefetch(spec.views[done : done + 1])
            panorama, view = scene.panoramas[row], cache.get(row)
            image = render_panorama(model, panorama.rotation, panorama.translation, spec.width, spec.near)
            mask = None if view.mask is None else view.mask.numpy()
            metrics = measure(image, view.image.numpy(), mask, crop_bottom=spec.crop_bottom, lpips=lpips)
            yield Evaluated(spec.task, panorama.name, metrics, encode_png(image))
            rate = done / max(time.monotonic() - start, 1e-9)
            yield Progress(
                spec.task,
                done,
                len(spec.views),
                rate,
                gaussians=len(model),
                memory=memory_in_use(spec.device),
                host_peak=host_peak(),
            )
