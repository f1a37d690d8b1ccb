"""Training of Stage I and Stage II: one generator of events (sec. 3.2 of the paper).

A trainer holds the state, its spec the constants. All randomness is a function of the seed, the task and the
iteration: a task that resumes from a checkpoint ends with the same bytes as one that was not interrupted.
"""

import logging
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from panolog.partition.cells import Volume
from panolog.renderer import ops
from panolog.renderer.baked import Baked
from panolog.renderer.camera import Camera
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache, View
from panolog.scene.model import Scene
from panolog.workers import stopping
from panolog.workers.capture.learning import Learning
from panolog.workers.comparison import better_block, with_block
from panolog.workers.events import Checkpoint, Event, Notice, Preview, Trained
from panolog.workers.merge import retained
from panolog.workers.meter import Meter
from panolog.workers.showing.previews import HeldOut, PreviewClock, picture, snapshot
from panolog.workers.sound_views import SoundViews, open_cache
from panolog.workers.specs import Source, TaskSpec
from panolog.workers.tasks import COARSE, Progress
from panolog.workers.training.checkpoint import loaded
from panolog.workers.training.checkpointing import Outbox, Saver, Tensors, copied
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.densify import Statistics, rate_units
from panolog.workers.training.exterior import Exterior, Rooms, exterior_last, inside
from panolog.workers.training.initialise import (
    camera_extent,
    evenly,
    first_model,
    near_distance,
    points_of,
    scene_length,
)
from panolog.workers.training.iterations import Direct, Pipeline, Planned
from panolog.workers.training.loss import Loss, loss_rows
from panolog.workers.training.optimizer import AVERAGE, Average, ModelState, check_kind, trained_rows
from panolog.workers.training.relocate import Growth, Place
from panolog.workers.training.schedule import Schedule, order
from panolog.workers.training.surfaces import Surfaces

_LOG = logging.getLogger(__name__)

PREFETCH = 4  # views that decode in the background ahead of the one in training
_START = "growth.start"  # in checkpoints: `Trainer.start`, absent in older ones


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainSpec(TaskSpec):
    """Trains the scene or a district (Stage I) or, with `initial` and `cell`, a block (Stage II)."""

    views: tuple[int, ...]  # rows of scene.panoramas to train on
    iterations: int
    config: TrainConfig
    seed: int
    initial: Source[Gaussians] | None = None  # Stage II: the full Stage I model, sky last
    cell: Volume | None = None  # Stage II: the cell of the block (eq. 12)
    district: Volume | None = None  # Stage I of a part of the place: what lies outside begins coarser
    compared: tuple[int, ...] = ()  # Stage II: rows on which a block must not be worse than `initial`
    shown: int | None = None  # row of a held-out panorama that previews show; None = the first of `views`
    checkpoint: Source[Checkpoint] | None = None  # to continue from
    outbox: Outbox | None = None  # where the worker leaves checkpoints itself, if it can

    def __post_init__(self) -> None:
        if (self.initial is None) != (self.cell is None):
            raise ValueError(f"task {self.task}: a block needs both its initial Gaussians and its cell")
        if not self.views:
            raise ValueError(f"task {self.task}: there are no views to train on")

    @property
    def bakes(self) -> bool:  # whether what surrounds it is baked
        return self.initial is not None and self.config.stage2.exterior == "baked"

    def run(self) -> Iterator[Event]:
        """`train`."""
        return train(self)


def train(spec: TrainSpec, stop: Callable[[], bool] = stopping.requested) -> Iterator[Event]:
    """Train a task from its start or from a checkpoint of it; the last event is `Trained`.

    When `stop` returns True, the last event is a checkpoint after the current iteration.
    Raises RunError if a loss or gradient is not finite or the checkpoint is of another task, InputError if an
    image cannot be read or more cannot be decoded than may be left out.
    """
    started = time.monotonic()
    scene, config = spec.scene.load(), spec.config
    first = scene.panoramas[spec.views[0]]
    rooms = Rooms.of(config.cache, spec.device, first, spec.width, bakes=spec.bakes, taken=spec.taken)
    with (
        open_cache(spec, scene, spec.views, rooms.host, rooms.device) as cache,
        closing(Trainer(spec, scene, cache, rooms.baked)) as trainer,
    ):
        if saved := (yield from loaded(spec.task, spec.checkpoint)):
            trainer.restore(saved)
        else:
            yield from trainer.begin()
        del saved  # its memory
        count, start = len(trainer.state.gaussians), trainer.iteration
        _LOG.info("%s: trains %d Gaussians from iteration %d of %d", spec.task, count, start, spec.iterations)
        yield from trainer.surround(stop)
        yield from trainer.run(stop)
    if trainer.iteration < spec.iterations:
        return
    result: Gaussians | None = trainer.result()
    if result is not None and spec.initial is not None and spec.cell is not None and spec.compared:
        models = spec.initial, spec.cell, result
        result = yield from better_block(spec, spec.compared, *models, trainer.near, stop)
    if result is None:  # stopped
        yield from trainer.saver.save(trainer.checkpoint, last=True)
    else:
        seconds, captured = time.monotonic() - started, trainer.learning.captured()
        yield Trained(spec.task, result, spec.iterations, seconds, captured)


class Trainer:
    """The state of one training task between two iterations, and the step from one to the next."""

    def __init__(self, spec: TrainSpec, scene: Scene, cache: PanoramaCache, room: int = 0) -> None:
        """Nothing is loaded yet. Args: room, bytes as in `BakedViews`."""
        self.spec, self.scene, self.cache, self._room = spec, scene, cache, room
        self.views = SoundViews(spec.task, scene, spec.views, cache, spec.config.images.damaged)
        self.near = near_distance(scene, spec.config)
        self.exact = spec.config.projection == "exact"
        self.centers = scene.centers[list(spec.views)]
        extent = camera_extent(scene, spec.views)
        self.schedule = Schedule(spec.config, spec.iterations, extent, spec.cell is not None)
        self.loss = Loss(scene, spec.config, spec.seed, self.schedule)
        self.meter = Meter(spec.task, spec.iterations, spec.device)
        self.previews = PreviewClock(spec.config.preview.every, spec.config.preview.seconds)
        self.shown = HeldOut(scene, spec.shown, spec.width, spec.locate)
        self.saver = Saver(spec.config.checkpoint, spec.outbox, spec.device)
        device = self.device = torch.device(spec.device)
        launch, count, broken = ops.launcher(device), self.meter.count, self._not_finite
        self.pipeline = Direct(count, broken) if launch is None else Pipeline(launch, device, count, broken)
        sizes, learns = {"width": spec.width, "iterations": spec.iterations}, spec.cell is None
        self.learning = Learning(scene, spec.views, spec.config, spec.device, **sizes, learns=learns)
        self.exterior: Exterior | None = None  # if it is baked
        self.average = Average()
        self.iteration = 0
        self.state: ModelState
        self.statistics: Statistics
        self.start = 0  # what the budget follows: sparse points, or scene Gaussians that a cell begins with

    def begin(self) -> Iterator[Progress]:
        """Start from points and the sky (Stage I) or the Stage I model (Stage II), with signs of work."""
        if self.spec.initial is not None:
            gaussians, sky = self._block(self.spec.initial), torch.ones(0, dtype=torch.bool)
            self.start = int(inside(gaussians, self.spec.cell).sum())
        else:
            gaussians, sky = yield from self._first()
        self.state = ModelState.start(replace(gaussians, exact=self.exact).to(self.spec.device))
        given = self.centers, self.schedule, scene_length(self.scene), sky
        self.state.units = rate_units(self.state.gaussians.means, *given)
        count, config = self.state.gaussians.scene.stop, self.spec.config.densify
        self.statistics = Statistics.zeros(count, self.spec.device, config)

    def _first(self) -> Generator[Progress, None, tuple[Gaussians, Tensor]]:
        """What Stage I starts with; (N_sky,) bool, which of the sky learn."""
        scene, spec, pixels = self.scene, self.spec, self.spec.width * (self.spec.width // 2)
        points = points_of(scene, spec.views, spec.district, spec.width)
        chosen = evenly(points, self.schedule.capped(len(points)))
        self.start = len(chosen)
        surfaces, missing = Surfaces(scene), self.schedule.first(self.start, pixels) - self.start
        mapped = [row for row in spec.views if missing and scene.panoramas[row].depth]
        for view in self.views.each(mapped, self.cache.ahead(PREFETCH)):
            surfaces.add(view, self.loss.depth.target(view))
            if self.meter.due():
                yield self.meter.progress(0, self.start)
        more = surfaces.points(scene.points[chosen], self.centers, missing)
        model, sky = first_model(scene, spec.config, chosen, more, spec.views, pixels, self.views.get)
        return model, sky if spec.config.sky.sharp else torch.ones_like(sky)

    def _block(self, initial: Source[Gaussians]) -> Gaussians:
        """What a block trains with, of the Stage I model."""
        kind = self.spec.config.stage2.exterior
        if kind == "full":
            return initial.load()
        gaussians = replace(exterior_last(initial.load(), self.spec.cell), exact=self.exact)
        if kind == "frozen":
            return gaussians
        self.exterior = Exterior(gaussians, self.near, self.loss.unit, self._room, self.device)
        return Exterior.own(gaussians)

    def surround(self, stop: Callable[[], bool]) -> Iterator[Event]:
        """Bake the exterior of a block for its cameras; after a stop the rest is baked when it is needed."""
        if (exterior := self.exterior) is None:
            return
        for row in (*self.spec.views, *self.shown.rows):
            if stop():
                return
            exterior.of(row, self._camera(row))
            if self.meter.due():
                yield self.meter.progress(self.iteration, len(self.state.gaussians))
        _LOG.info("%s: %s", self.spec.task, exterior.finish(self._cameras()))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint. Raises RunError if it is of another training."""
        if checkpoint.task != self.spec.task or checkpoint.iteration > self.spec.iterations:
            what = f"{self.spec.task} with {self.spec.iterations} iterations"
            raise RunError(
                f"a checkpoint of {checkpoint.task} at {checkpoint.iteration} does not continue {what}"
            )
        check_kind(checkpoint.tensors, self.spec.config)
        held = {name: tensor for name, tensor in checkpoint.tensors.items() if not name.startswith(AVERAGE)}
        tensors = {name: tensor.to(self.spec.device, copy=True) for name, tensor in held.items()}
        self.state = ModelState.from_tensors(tensors)
        if self.spec.initial is not None and self.spec.bakes:
            self._block(self.spec.initial)
        self.statistics = Statistics.from_tensors(tensors, self.spec.config.densify)
        self.average = Average.from_tensors(checkpoint.tensors)
        self.learning.restore(tensors)
        self.views.restore(tensors)
        known = tensors.get(_START)
        self.start = int(inside(self.state.gaussians, self.spec.cell).sum()) if known is None else int(known)
        self.iteration = checkpoint.iteration

    def checkpoint(self, copy: Callable[[Tensors], dict[str, Tensor]] = copied) -> Checkpoint:
        """The whole state, copied to the CPU: steps change it in place."""
        self.settle()
        tensors = self.state.tensors() | {
            _START: torch.tensor(self.start),
            **self.statistics.tensors(),
            **self.average.tensors(),
            **self.learning.tensors(),
            **self.views.tensors(),
        }
        return Checkpoint(self.spec.task, self.iteration, copy(tensors))

    def run(self, stop: Callable[[], bool]) -> Iterator[Event]:
        """All remaining iterations, or those until `stop`, with their events."""
        while self.iteration < self.spec.iterations:
            iteration = self.iteration = self.iteration + 1
            last = iteration == self.spec.iterations
            view = self._view(iteration)
            self.step(iteration, view)
            yield from self._maintain(iteration, last)
            yield from self.views.notices()
            yield from self.saver.finished()
            while self.loss.depth.notices:
                yield Notice(self.spec.task, self.loss.depth.notices.pop(0))
            if self.meter.due() or last:
                count, rates = len(self.state.gaussians), self.schedule.rates(iteration)
                yield self.meter.progress(iteration, count, rates)
            if self.previews.due(iteration) or last:
                with self.previews.timed():  # with the time that it takes to be sent
                    yield self._preview()
            stopped = stop() and not last
            if stopped or (self.saver.due(iteration) and not last):
                yield from self.saver.save(self.checkpoint, last=stopped)
            if stopped:
                return
        yield from self.saver.finished(wait=True)
        exterior, initial, cell = self.exterior, self.spec.initial, self.spec.cell
        if _LOG.isEnabledFor(logging.INFO) and exterior and initial and cell:
            self.settle()
            own = self.state.gaussians.to("cpu")
            found = exterior.differences(own, with_block(initial.load(), cell, own), self._cameras())
            _LOG.info("%s: at the end the colours of what is baked %s", self.spec.task, found)

    def result(self) -> Gaussians:
        """The whole model (Stage I), or the block's retained set (eq. 12)."""
        self.settle()
        gaussians = self.state.gaussians.to("cpu")
        if self.spec.cell is None:
            return gaussians
        return retained(gaussians, self.spec.cell, self.spec.config.densify.prune_opacity)

    def close(self) -> None:
        """Drops what surrounds a block, with its thread and its file; iterations in flight hold theirs."""
        if self.exterior is not None:
            self.exterior.views.close()
        self.exterior = None

    def _view(self, iteration: int) -> View:
        """The view of this iteration; the next ones start to decode."""
        ahead = range(iteration, min(iteration + self.cache.ahead(PREFETCH), self.spec.iterations) + 1)
        known = self.views.left_out
        coming = [next(row for row in self._order(i) if row not in known) for i in ahead]
        self.cache.prefetch(coming)
        if self.exterior is not None:
            self.exterior.views.prefetch(coming)
        view = self.loss.aligned(self.views.first(self._order(iteration)), iteration)
        return self.learning.view(view)

    def _order(self, iteration: int) -> Iterator[int]:
        return order(self.spec.seed, str(self.spec.task), self.spec.views, iteration)

    def _camera(self, row: int) -> Camera:
        if row == self.spec.shown:  # nothing is learnt of it
            return Camera.at(self.scene.panoramas[row], self.spec.width)
        return self.learning.camera(row, self.spec.width)

    def _cameras(self) -> dict[int, Camera]:
        return {row: self._camera(row) for row in self.spec.views}

    def _around(self, row: int) -> Baked | None:
        """What a camera sees of a baked exterior."""
        return None if self.exterior is None else self.exterior.of(row, self._camera(row))

    def step(self, iteration: int, view: View) -> None:
        """One iteration of eq. 6 on one view. On a card it has only begun, see `pipeline`.

        Raises RunError if its loss or a gradient is not finite, on a card those of an earlier iteration.
        """
        self.pipeline.run(self._plan(iteration, view))

    def settle(self) -> None:
        """Waits for the iterations that have begun: all is then as after the last. Raises as `step`."""
        self.pipeline.settle()

    def _not_finite(self, what: str, planned: Planned) -> RunError:
        where = f"iteration {planned.iteration}, view {self.scene.panoramas[planned.view].name}"
        return RunError(f"{self.spec.task}: the {what} is not finite at {where}")

    def _plan(self, iteration: int, view: View) -> Planned:
        """An iteration as it is to be done."""
        degree, weight = self.schedule.sh_degree(iteration), self.loss.depth_weight(iteration)
        around = self._around(view.row)
        problem = Problem(
            model=self.state.gaussians.tensors(),
            camera=self._camera(view.row),
            image=view.image,
            **self.loss.targets(view, weight, around)._asdict(),
            depth_weight=weight,
            lambda_ssim=self.spec.config.loss.lambda_ssim,
            rows=loss_rows(self.spec.config.loss, view),
            sh_degree=degree,
            near=self.near,
            exact=self.state.gaussians.exact,
            exterior=around,
            exposure=view.exposure,
            moving=self.learning.moving(iteration),
            absolute=self.statistics.absolute is not None and self.schedule.collects(iteration),
        )
        return Planned(
            iteration=iteration,
            view=view.row,
            problem=problem,
            state=self.state,
            rates=self.schedule.rates(iteration),
            rows=trained_rows(
                self.state.gaussians, degree, refine=self.schedule.refine, sharp=self.spec.config.sky.sharp
            ),
            sizes=self.schedule.sizes(self.spec.width),
            statistics=self.statistics if self.schedule.collects(iteration) else None,
            learning=self.learning if self.spec.cell is None else None,
        )

    def _maintain(self, iteration: int, last: bool) -> Iterator[Event]:
        """After a step, when due: average, drop invalid Gaussians, densify, reset opacities, drop haze."""
        averages, changes = self.schedule.averages(iteration), self.schedule.changes(iteration)
        if averages or changes:
            self.settle()
        if averages:
            self.average.add(self.state.gaussians)
        if last:
            self.state.gaussians = self.average.take(self.state.gaussians)
        if changes:
            place = Place(self.spec.cell, self.start, self.spec.width**2 // 2)
            growth = Growth(self.schedule, place, self.spec.seed, str(self.spec.task))
            before = self.statistics
            self.statistics, invalid = growth.after(self.state, before, iteration)
            if self.statistics is not before or self.schedule.resets(iteration):
                self.average.clear()
            if invalid:
                message = f"{invalid} Gaussians were not finite at iteration {iteration}: removed"
                yield Notice(self.spec.task, message)

    def _preview(self) -> Preview:
        """A held-out panorama or the first training view as rendered now; of Stage I with a snapshot."""
        self.settle()
        spec, model, saved = self.spec, self.state.gaussians, None
        row, photograph = self.shown.photograph(lambda: self.views.first(spec.views))
        degree, around = self.schedule.sh_degree(self.iteration), self._around(row)
        with torch.no_grad():
            rendered = render(model, self._camera(row), sh_degree=degree, near=self.near, exterior=around)
            jpeg = picture(rendered.color, photograph, around)
            if spec.task == COARSE and self.iteration < spec.iterations:  # the model follows
                saved = Checkpoint(spec.task, self.iteration, snapshot(model, self.centers.mean(axis=0)))
        shown = self.scene.panoramas[row].name, jpeg, row == spec.shown
        return Preview(spec.task, self.iteration, *shown, saved)
