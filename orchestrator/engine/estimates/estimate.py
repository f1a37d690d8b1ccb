"""What every stage of a job needs, from its scene, its settings, a calibration and the machines there are.

Memory. What a Gaussian takes is in `calibration`, on a GPU in `workers.device_memory`. All else (the process,
the images of a step, what decoding needs) is what the calibration's process had beyond its own Gaussians and
panoramas; decoded panoramas stay within `cache.memory`. A block with a baked exterior trains what its cell
has; the fullest cell is expected to have as large a share of the Gaussians as of the sparse points.

Time. An iteration takes a + b · Gaussians seconds: the calibration has tried two numbers of them, and
`workers.growth_law` predicts how many there will be. Tasks that share the cores have one thread each, or as
many as there are cores for each. Checkpoints and previews are left out: they cost less than the rest errs.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

from panolog.orchestrator.engine.estimates import calibration
from panolog.orchestrator.engine.estimates.calibration import AVERAGE, CHECKPOINT, PIXEL, TRAINED, Basis
from panolog.orchestrator.engine.estimates.costs import Estimate, Pace, StageEstimate
from panolog.orchestrator.engine.estimates.place_parts import Parts
from panolog.orchestrator.engine.scheduling.placement import USABLE
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.thinning import PREVIEWS, ROW, most_stored
from panolog.scene.images import view_bytes
from panolog.scene.model import Scene
from panolog.workers import device_memory
from panolog.workers.device_memory import VALUES
from panolog.workers.growth_law import Period, additions, population
from panolog.workers.metrics import LPIPS_BYTES
from panolog.workers.showing.previews import PREVIEW_WIDTH
from panolog.workers.tasks import Stage
from panolog.workers.training.exterior import BAKED, PASSING, READING
from panolog.workers.training.initialise import camera_extent
from panolog.workers.training.schedule import Schedule

_PLY = 62 * 4
_HELD = 2 * VALUES  # of it while it is trained: the model as it was, and its place in the task's fields
_DISK = 200e6  # bytes per second: what a SATA disk writes
_LEVELS = 3  # times the bytes of a model that files without names have of it
_LOOKS = 70  # renders for the seam of a face: as measured on a street and on a flight
_DELIVERED = 40_000  # Gaussians per second of files for viewers
_PLAN = 1.0  # seconds: the plan and its picture
_JPEG = 0.3  # bytes of a pixel of a preview
_UNKNOWN = 3 * 86_400.0  # seconds of a stage of which nothing was measured


@dataclass(frozen=True, eq=False)
class Estimator:
    """Estimates of one job. Its device is "cpu" or "cuda", its blocks are a grid."""

    scene: Scene
    config: RunConfig
    basis: Basis
    nodes: Sequence[Node]

    def estimate(self) -> Estimate:
        coarse, block = self._whole + self._sky, self._block[-1][1] + self._frozen_sky
        stages = self._coarse_stages(coarse)
        merged = coarse
        if self.config.refine:
            stages += self._refinement(coarse)
            merged += self.config.grid.count * (self._block[-1][1] - self._starts_with(coarse))
        stages += self._finish(merged)
        if self.config.deliver:
            stages.append(self._stage(Stage.DELIVER, 1, merged, (0, 0), lambda _: merged / _DELIVERED))
        disk = self._disk(coarse, block, merged) + self._repeated(stages)
        return Estimate(self.config.blocks, tuple(stages), disk)

    @cached_property
    def parts(self) -> Parts:
        return Parts(self.scene, self.config, self.width)

    def _coarse_stages(self, gaussians: int) -> list[StageEstimate]:
        sky, count, cameras = self._sky, self.config.districts, self.parts.district[0]
        largest = self._coarse[-1][1] + sky

        def training(together: int) -> float:
            return math.ceil(count / together) * self._pace.training(self._coarse, cameras, together, sky)

        need = self.host(largest, cameras), self.memory(largest, cameras) if self._cuda else 0
        if count == 1:
            return [self._stage(Stage.COARSE, 1, gaussians, need, training)]
        return [
            self._stage(Stage.DISTRICT, count, largest, need, training),
            self._stage(Stage.COARSE, 1, gaussians, (0, 0), lambda _: self._writing(gaussians)),
        ]

    def refinement(self, coarse: int, blocks: int, cameras: int) -> StageEstimate:
        """Stage II of a plan.

        Args: coarse, Gaussians that Stage I came to, sky included; blocks that are trained; cameras, training
        panoramas of the fullest one.
        """
        return self._refining(Stage.BLOCK, blocks, coarse, self._periods(self._starts_with(coarse)), cameras)

    def block(self, coarse: int, own: int, cameras: int) -> StageEstimate:
        """One block of a plan, alone on the machines.

        Args: coarse, Gaussians that Stage I came to, sky included; own, those of them in its cell; cameras,
        training panoramas of it.
        """
        start = own if self.bakes else max(coarse - self._sky, 0)
        return self._refining(Stage.BLOCK, 1, coarse, self._periods(start), cameras)

    def _refining(
        self, stage: Stage, tasks: int, whole: int, periods: list[Period], cameras: int
    ) -> StageEstimate:
        """A stage whose tasks train parts of a model of `whole` Gaussians on at most so many panoramas."""
        gaussians = periods[-1][1] + self._frozen_sky
        initial = self._sky + self.parts.block_reads(whole - self._sky, periods[0][1])
        need = self.host(gaussians, cameras, initial), self.device(gaussians, PASSING)

        def training(together: int) -> float:
            steps = self._pace.training(periods, cameras, together, self._frozen_sky)
            return math.ceil(tasks / together) * steps

        return self._stage(stage, tasks, gaussians, need, training)

    def _refinement(self, coarse: int) -> list[StageEstimate]:
        train, blocks, cameras = len(self.scene.train), self.config.grid.count, self.parts.block_cameras
        seen, need = self.scored(coarse)

        def scoring(together: int) -> float:
            each = self._pace.iteration(seen, together) + self.basis.measured.decode
            return self.basis.startup * (together > 1) + train * each / together + _PLAN

        return [
            self._stage(Stage.SCORE, len(self.parts.scored), seen, need, scoring),
            self._refining(Stage.BLOCK, blocks, coarse, self._block, cameras),
            *self._passes(),
        ]

    def scored(self, coarse: int) -> tuple[int, tuple[int, int]]:
        """Gaussians that a shard is scored with, sky included, and what it needs as in `rendering`.

        Args: coarse, Gaussians that Stage I came to, sky included.
        """
        seen = self._sky + self.parts.scored_with(coarse - self._sky)
        return seen, self.scoring(seen, len(self.parts.scored[0]))

    def measured(self, merged: int) -> tuple[int, tuple[int, int]]:
        """What a shard of the evaluation needs, as `scored`. Args: merged, Gaussians of the merged model."""
        views, faces = self.parts.measured_with(merged - self._sky)
        seen, around = views + self._sky, faces + self._sky
        host, device = self.rendering(seen, max(map(len, self.parts.measured), default=0))
        if not faces:
            return seen, (host, device)
        with_both, on_gpu = self.rendering(around, len(self.parts.around))
        with_both += around * VALUES  # the Stage I model
        return max(seen, around), (max(host, with_both), max(device, on_gpu))

    def _passes(self) -> list[StageEstimate]:
        blocks, own, stages = self.config.grid.count, self._block[-1][1], list[StageEstimate]()
        whole = blocks * own + self._sky
        for stage in self.config.passes.stages:
            periods = [(self.config.later(stage).iterations, own)]
            tasks = blocks if stage is Stage.ROUND else max(1, self.parts.faces)
            stages.append(self._stage(Stage.UNION, 1, whole, (0, 0), lambda _: self._writing(whole)))
            stages.append(self._refining(stage, tasks, whole, periods, self.parts.block_cameras))
        return stages

    def _finish(self, merged: int) -> list[StageEstimate]:
        """Merge, which is the driver's, and evaluation, which is too if its shards are tasks of their own."""
        views = len(self.scene.test) + _LOOKS * self.parts.seams
        seen, need = self.measured(merged) if self.parts.measures else (merged, self.rendering(merged, views))

        def measuring(together: int) -> float:
            each = self.basis.measured.look * self._pace.slowdown(together) + self._pace.decode
            seconds = views * each + self.parts.fits * self._pace.iteration(seen, together)
            return self.basis.startup * (together > 1) + seconds / together

        merge = self._stage(Stage.MERGE, 1, merged, (0, 0), lambda _: self._writing(merged))
        if not self.parts.measures:
            return [merge, self._stage(Stage.EVAL, 1, merged, need, measuring)]
        shards = self._stage(Stage.MEASURE, self.parts.measures, seen, need, measuring)
        return [merge, shards, self._stage(Stage.EVAL, 1, merged, (0, 0), lambda _: 0.0)]

    def _writing(self, gaussians: int) -> float:
        return 2 * gaussians * _PLY / _DISK

    def _disk(self, coarse: int, block: int, merged: int) -> int:
        """Bytes of models and checkpoints, each of which is written before its predecessor is removed."""
        blocks = self.config.grid.count if self.config.refine else 0
        largest, together = (block, self.slots(self.host(block, 0))) if blocks else (coarse, 1)
        last = max(1, min(blocks, together)) * largest * self._saved  # workers write them at once
        written = (2 if blocks else 1) + (2 * len(self.config.passes.stages) if blocks else 0)
        levels = _LEVELS if self.config.stage2.reduces and blocks else 0  # and the model sorted by blocks
        models = (coarse if self.config.districts == 1 else 3 * coarse) + (written + levels) * merged
        return models * _PLY + (1 + self.config.retention.checkpoints) * last

    def _repeated(self, stages: Sequence[StageEstimate]) -> int:
        """Bytes at most of the progress and the previews that are kept: see `thinning`."""
        previews = int(PREVIEWS * _JPEG * min(self.width, PREVIEW_WIDTH) ** 2)
        size = 0
        for stage in stages:
            if stage.name.trains:
                seconds = _UNKNOWN if stage.seconds is None else stage.seconds
                size += stage.tasks * (most_stored(seconds) * ROW + previews)
        return size

    def memory(self, gaussians: int, cameras: int) -> int:
        """Peak bytes of a task of Stage I where it computes: of its GPU, or of its process on the CPU."""
        on_gpu = self.device(gaussians) + self.parts.learning(cameras)
        return on_gpu if self._cuda else self.host(gaussians, cameras)

    def capacity(self, memory: int) -> int:
        """Gaussians that can be trained in so many bytes, panoramas aside."""
        if self._cuda:
            return device_memory.trainable(memory - self._beyond, self._pixels)
        return max(0, memory - self._fixed(0)) // self._each

    def _starts_with(self, coarse: int) -> int:
        """Scene Gaussians that the largest block starts with, if Stage I came to so many, sky included."""
        own = max(coarse - self._sky, 0)
        return math.ceil(own * self.parts.share) if self.bakes else own

    @property
    def bakes(self) -> bool:  # whether blocks have a baked exterior
        return self.config.stage2.exterior == "baked"

    @property
    def baked_view(self) -> int:
        """Bytes of a baked exterior for one camera, where a block computes."""
        return self._pixels * BAKED if self.bakes else 0

    @property
    def kept_view(self) -> int:  # bytes that a block keeps for a panorama, if there is room
        return self._view_bytes + (0 if self._cuda else self.baked_view)

    @property
    def _frozen_sky(self) -> int:
        return 0 if self.bakes else self._sky

    @cached_property
    def _periods(self) -> Callable[[int], list[Period]]:
        schedule = replace(self._schedule, refine=True)
        return cache(lambda start: population(start, self._added, self._pixels, schedule))

    def host(self, gaussians: int, cameras: int, initial: int = 0) -> int:
        """Peak bytes of the process of a task that trains so many Gaussians on so many panoramas.

        Args: initial, the Gaussians of the model that it starts from, if it reads one.
        """
        baked = self.baked_view if initial else 0
        need = self._fixed(cameras, 0 if self._cuda else baked) + initial * _HELD + READING * baked
        copies = 2 * self._saves + (not self._cuda)  # of what Stage I learns, as of its model
        need += initial * calibration.SPLAT * self.bakes if initial else copies * self.parts.learning(cameras)
        if self._cuda:  # copies for a checkpoint
            average = AVERAGE if self.config.optimizer.average else 0
            return need + gaussians * (average + (2 * self._saved if self._saves else 0))
        return need + gaussians * self._each

    def rendering(self, gaussians: int, views: int) -> tuple[int, int]:
        """Peak bytes, of its process and of its GPU, of a task that measures so many views and fits poses."""
        if self._cuda:
            most = device_memory.scoring if self.config.poses.refine else device_memory.rendering
            on_gpu = most(gaussians, self._pixels) + LPIPS_BYTES + self._beyond
            return self._fixed(views) + gaussians * VALUES, on_gpu
        return self._fixed(views) + gaussians * (2 * VALUES + calibration.SPLAT), 0

    def scoring(self, gaussians: int, views: int) -> tuple[int, int]:
        """The host and GPU bytes of a task that scores so many views: it also has gradients."""
        host, _ = self.rendering(gaussians, views)
        on_gpu = device_memory.scoring(gaussians, self._pixels) + self._beyond if self._cuda else 0
        return host, on_gpu

    def device(self, gaussians: int, baked: int = 0) -> int:
        """Peak bytes of the same task on its GPU, 0 on the CPU. Checkpoints are in the host's memory.

        Args: baked, views on it with what is baked for them; others stay there as far as there is room.
        """
        if not self._cuda:
            return 0
        return device_memory.training(gaussians, self._pixels) + self._beyond + baked * self.baked_view

    @cached_property
    def _beyond(self) -> int:
        """Bytes of a GPU beyond what is counted: the context, and what the calibration had more or less."""
        grown, width = self.basis.measured.grown, self.basis.measured.width
        counted = device_memory.training(grown.gaussians, width * (width // 2))
        return device_memory.CONTEXT + grown.device - counted

    def slots(self, host: int) -> int:
        """How many tasks work at a time, at least one: as GPUs, or cores and memory, allow.

        Args: host, bytes of a task's process.
        """
        if self._cuda:
            return max(1, sum(len(node.gpus) for node in self.nodes))
        allowed = (min(node.cpus, max(1, int(node.memory * USABLE / max(host, 1)))) for node in self.nodes)
        return max(1, sum(allowed))

    @cached_property
    def _schedule(self) -> Schedule:
        extent = camera_extent(self.scene, self.scene.train)
        return Schedule(self.config, self.config.iterations, extent, refine=False)

    @property
    def _points(self) -> int:
        """Sparse points that the cap on Gaussians leaves Stage I."""
        return self._schedule.capped(self.parts.points)

    @cached_property
    def _start(self) -> int:
        """Scene Gaussians that Stage I starts with; of several districts, that of the one with most."""
        return self._schedule.first(self._points, self._pixels) if self.parts.mapped else self._points

    @cached_property
    def _added(self) -> float:
        return additions(self._start, self.basis.measured.share, self._pixels)

    @cached_property
    def _coarse(self) -> list[Period]:
        return population(self._points, self._added, self._pixels, self._schedule, self._start)

    @property
    def _whole(self) -> int:  # scene Gaussians that Stage I comes to
        return math.ceil(self._coarse[-1][1] * len(self.scene.points) / max(1, self.parts.points))

    @cached_property
    def _block(self) -> list[Period]:
        return self._periods(self._starts_with(self._whole + self._sky))

    @property
    def _cuda(self) -> bool:
        return self.config.device == "cuda"

    @property
    def _saves(self) -> bool:
        return self.config.checkpoint.every < self.config.iterations

    @property
    def _saved(self) -> int:
        return CHECKPOINT + (AVERAGE if self.config.optimizer.average else 0)

    @property
    def width(self) -> int:
        """The width of the training in pixels."""
        return self.config.width or self.scene.width

    @property
    def largest(self) -> int:
        """Bytes that a task can have, of the largest machine or GPU and by the settings; 0 = unknown."""
        gpus = (gpu.memory for node in self.nodes for gpu in node.gpus)
        most = max(gpus if self._cuda else (node.memory for node in self.nodes), default=0)
        allowed = int((self.config.memory or 0) * 2**30)
        return min(most or allowed, allowed or most)

    @property
    def _sky(self) -> int:
        return self.config.sky.number(self._pixels)

    @property
    def _pixels(self) -> int:
        return self.width * (self.width // 2)

    @cached_property
    def _pace(self) -> Pace:
        kept = max(1, int(self.config.cache.memory * 2**30 / self._view_bytes))
        return Pace(self.basis, self._pixels, max(1, len(self.nodes)), kept, cuda=self._cuda)

    @cached_property
    def _view_bytes(self) -> int:
        return max(view_bytes(self.scene.panoramas[row], self.width) for row in self.scene.train)

    @property
    def _each(self) -> int:
        return TRAINED + (2 * self._saved if self._saves else 0)

    def _fixed(self, cameras: int, baked: int = 0) -> int:
        """Bytes of a worker's process with the decoded panoramas, but without Gaussians that it trains.

        Args: baked, bytes that are kept for each panorama besides.
        """
        measured = self.basis.measured
        kept = min(int(self.config.cache.memory * 2**30), cameras * (self._view_bytes + baked))
        own = measured.grown.host - measured.images + kept
        if self._cuda:
            return own
        pixels = self._pixels - measured.width * (measured.width // 2)
        return own - measured.grown.gaussians * TRAINED + pixels * PIXEL

    def _stage(
        self, name: Stage, tasks: int, gaussians: int, need: tuple[int, int], seconds: Callable[[int], float]
    ) -> StageEstimate:
        """Args: need, bytes of a task's process and of its GPU; seconds, by how many tasks run together."""
        together = min(tasks, self.slots(need[0]))
        took = seconds(together) if self.basis.timed else None
        return StageEstimate(name, tasks, together, gaussians, *need, took)
