"""Evaluation: the model against panoramas that it has never seen."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from panolog.renderer.render import encode_png, render_panorama
from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply
from panolog.workers.events import Evaluated, Event, Notice, Progress
from panolog.workers.meter import forget_peaks, host_peak, memory_in_use
from panolog.workers.metrics import load_lpips, measure

_IMAGE_MEMORY = 2**30  # bytes of decoded panoramas; each one is needed once


@dataclass(frozen=True, eq=False)
class EvaluateTask:
    """Which panoramas to render with which model, and what counts."""

    scene: Scene
    views: tuple[int, ...]  # rows of scene.panoramas, normally scene.test
    width: int  # pixels; height is width / 2
    gaussians: Gaussians | Path  # the model, or its PLY
    near: float  # world units below which nothing is drawn, as in training
    crop_bottom: float = (
        0.0  # fraction of the height that does not count (the paper: 0.1 for hand-held cameras)
    )
    device: str = "cpu"
    name: str = "eval"
    locate: Locate = here  # where the panoramas and the PLY are


def evaluate(task: EvaluateTask) -> Iterator[Event]:
    """Renders and measures each view: one Evaluated and one Progress for each; a Notice if there is no LPIPS.

    Raises InputError if the PLY or an image cannot be read.
    """
    forget_peaks(task.device)
    model = read_ply(task.locate(task.gaussians)) if isinstance(task.gaussians, Path) else task.gaussians
    model = model.to(task.device)
    lpips, reason = load_lpips(task.device)
    if reason:
        yield Notice(task.name, reason)
    start = time.monotonic()
    with PanoramaCache(task.scene, task.views, task.width, _IMAGE_MEMORY, task.locate) as cache:
        for done, row in enumerate(task.views, 1):
            cache.prefetch(task.views[done : done + 1])
            panorama, view = task.scene.panoramas[row], cache.get(row)
            image = render_panorama(model, panorama.rotation, panorama.translation, task.width, task.near)
            mask = None if view.mask is None else view.mask.numpy()
            metrics = measure(image, view.image.numpy(), mask, crop_bottom=task.crop_bottom, lpips=lpips)
            yield Evaluated(task.name, panorama.name, metrics, encode_png(image))
            rate = done / max(time.monotonic() - start, 1e-9)
            yield Progress(
                task.name,
                done,
                len(task.views),
                rate,
                gaussians=len(model),
                memory=memory_in_use(task.device),
                host_peak=host_peak(),
            )
