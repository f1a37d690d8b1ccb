"""Evaluation: the model against held-out panoramas, and along the faces between its blocks."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from panolog.partition.faces import Plane
from panolog.renderer.render import encode_png, render_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View
from panolog.scene.model import Panorama, Scene
from panolog.workers.capture.pose_fit import PoseFit, fit_steps
from panolog.workers.events import Evaluated, Event, LpipsMissing
from panolog.workers.meter import Meter
from panolog.workers.metrics import Lpips, load_lpips, measure
from panolog.workers.seams.measurement import SeamMeasurement, Seams
from panolog.workers.sound_views import SoundViews, open_cache
from panolog.workers.specs import Source, TaskSpec
from panolog.workers.tasks import EVAL, Progress, TaskId
from panolog.workers.training.task_config import ImagesConfig

FACES = 2  # of a shard: what is around more of them would be much of the place
_IMAGE_MEMORY = 2**30  # bytes of decoded panoramas; each one is needed once


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluateSpec(TaskSpec):
    """Renders panoramas with a model and compares them with their photographs: all, or those of a shard."""

    task: TaskId = EVAL
    views: tuple[int, ...]  # rows of scene.panoramas, normally scene.test
    model: Source[Gaussians]
    near: float  # world units, the least radial distance drawn, as in training
    crop_bottom: float = 0.0  # fraction of the height left out (the paper: 0.1 for hand-held cameras)
    damaged: float = ImagesConfig().damaged  # fraction of the views that may be left out
    seams: Seams | None = None  # what is measured besides
    pose_fit: float | None = None  # λ of the loss that a pose is fitted with to measure there too; None = not

    @property
    def faces(self) -> tuple[Plane, ...]:
        """The faces whose seams are measured."""
        return () if self.seams is None else self.seams.faces

    def run(self) -> Iterator[Event]:
        """Renders and measures each view: an Evaluated and a Progress for each; first, perhaps, LpipsMissing.

        A panorama that cannot be decoded has LeftOut in place of Evaluated. Then come the seams.

        Raises InputError if the PLY or an image cannot be read, or too many images cannot be decoded.
        """
        host = self.model.load()
        steps = _Steps(Meter(self.task, len(self.views), self.device), len(self.views), len(host))
        seams = None if self.seams is None else SeamMeasurement(self, self.seams, self.near, steps.done)
        steps.meter.iterations += 0 if seams is None else seams.renders
        if self.views:
            yield from _evaluate_views(self, host.to(self.device), steps)
        if seams is not None:
            yield from seams.measure(host)


@dataclass
class _Steps:
    """What an evaluation says of its progress."""

    meter: Meter
    views: int  # each of which is reported
    gaussians: int
    count: int = 0  # of views and renders for seams so far

    def done(self) -> Iterator[Progress]:
        """After a view, or a render for seams."""
        self.meter.count()
        self.count += 1
        if self.count in (*range(self.views + 1), self.meter.iterations):
            yield self.meter.progress(self.count, self.gaussians)
        else:
            yield from self.alive()

    def alive(self) -> Iterator[Progress]:
        """In between."""
        if self.meter.due():
            yield self.meter.progress(self.count, self.gaussians)


def _evaluate_views(spec: EvaluateSpec, model: Gaussians, steps: _Steps) -> Iterator[Event]:
    scene = spec.scene.load()
    lpips, reason = load_lpips(spec.device)
    if reason:
        yield LpipsMissing(spec.task, reason)
    with open_cache(spec, scene, spec.views, _IMAGE_MEMORY) as cache:
        views = SoundViews(spec.task, scene, spec.views, cache, spec.damaged)
        for done, row in enumerate(spec.views, 1):
            cache.prefetch(spec.views[done : done + cache.ahead(1)])
            panorama, view = scene.panoramas[row], views.get(row)
            yield from views.notices()
            if view is not None:
                options = spec.width, spec.near, spec.crop_bottom, lpips
                metrics, png = evaluate_view(model, panorama, view, *options)
                there: dict[str, float | None] | None = None
                for fit in _fits(spec, model, scene, view):
                    yield from steps.alive()
                    fitted = replace(panorama, rotation=fit.rotation, translation=fit.translation)
                    there = {"pixels": fit.pixels}
                if there is not None:
                    there = evaluate_view(model, fitted, view, *options)[0] | there
                yield Evaluated(spec.task, panorama.name, metrics, png, there)
            yield from steps.done()


def _fits(spec: EvaluateSpec, model: Gaussians, scene: Scene, view: View) -> Iterator[PoseFit]:
    """The steps of fitting a view's pose to the model; none if that is not wanted."""
    if spec.pose_fit is None:
        return
    panorama = scene.panoramas[view.row]
    yield from fit_steps(
        model,
        view,
        panorama.rotation,
        panorama.translation,
        points=scene.points[panorama.observed],
        near=spec.near,
        lambda_ssim=spec.pose_fit,
        gained=any(each.exposure is not None for each in scene.panoramas),
    )


def evaluate_view(
    model: Gaussians,
    panorama: Panorama,
    view: View,
    width: int,
    near: float,
    crop_bottom: float = 0.0,
    lpips: Lpips | None = None,
) -> tuple[dict[str, float | None], bytes]:
    """The metrics of one panorama and its render as a PNG; arguments as in `EvaluateSpec` and `measure`."""
    image = render_bytes(model, panorama.rotation, panorama.translation, width, near)
    metrics = measure(image, view.image, view.mask, crop_bottom=crop_bottom, lpips=lpips)
    return metrics, encode_png(image.cpu().numpy())
