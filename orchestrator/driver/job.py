"""A job and its tasks: what each needs to run, and what they share."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from panolog.orchestrator.driver.evaluation import Evaluation
from panolog.orchestrator.driver.partitioning import block_labels
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import RunInfo
from panolog.orchestrator.run.policy import shards_of
from panolog.partition.plan import Plan, read_plan
from panolog.scene.errors import InputError
from panolog.scene.files import Locate
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from panolog.workers import specs
from panolog.workers.training import checkpoint
from panolog.workers.training.initialise import near_distance

Prepared = tuple[Callable[..., Any], dict[str, Any], int]  # work, its fields, the iteration it goes on from


@dataclass(frozen=True, eq=False)
class Job:
    """A scene, what to do with it, and where."""

    folder: RunFolder
    scene: Scene
    config: RunConfig  # resolved: `width` and `device` say what is used

    @property
    def width(self) -> int:
        """Pixels of the panoramas in training and evaluation."""
        return self.config.width or self.scene.width

    @cached_property
    def shards(self) -> tuple[tuple[int, ...], ...]:
        """The training cameras as they are scored."""
        return shards_of(self.scene.train)

    @cached_property
    def near(self) -> float:
        """World units nearer than which nothing is drawn."""
        return near_distance(self.scene, self.config)


def scene_of(info: RunInfo) -> Scene:
    """The scene of a run. Raises InputError if it is gone or no longer what the run began with."""
    scene = read_scene(Path(info.scene.path))
    if scene.fingerprint != info.scene.fingerprint:
        raise InputError(f"{scene.root}: the scene has changed since the run began; start a new run")
    return scene


class Shared:
    """What several tasks need, put where workers find it when the first one asks, and the way to files.

    Args: put shares a value with all tasks; share(files of the scene, files of the run) makes the `Locate`
    of a task.
    """

    def __init__(
        self,
        job: Job,
        put: Callable[[object], Any],
        share: Callable[[Iterable[Path], Iterable[Path]], Locate],
    ) -> None:
        self._job = job
        self._put = put
        self._share = share

    @cached_property
    def scene(self) -> Any:
        """The scene."""
        return self._put(self._job.scene)

    @cached_property
    def coarse(self) -> Gaussians:
        """The Stage I model, here."""
        return read_ply(self._job.folder.model("coarse"))

    @cached_property
    def labels(self) -> Any:
        """The block of each scene Gaussian of the Stage I model, for workers."""
        return self._put(block_labels(self._job.scene, self.coarse, self._job.config))

    @cached_property
    def plan(self) -> Plan:
        """The partition, here."""
        return read_plan(self._job.folder.plan)

    def locate(self, views: Iterable[int], *made: Path) -> Locate:
        """Where a worker finds the files of some panoramas, and files that the run has made."""
        files = (file for row in views for file in self._job.scene.panoramas[row].files)
        return self._share(files, made)


def prepare(job: Job, shared: Shared, name: str) -> Prepared:
    """How to run a task. Raises RunError if its checkpoint is damaged."""
    if name == "coarse":
        return _training(job, shared, name, views=job.scene.train, initial=None)
    stage, _, number = name.partition("/")
    if stage == "block":
        plan, block = shared.plan, int(number)
        views, cell = plan.cameras(block), plan.cell(block)
        return _training(job, shared, name, views=views, initial=job.folder.model("coarse"), cell=cell)
    if stage == "score":
        return specs.score_work, score_fields(job, shared, name, job.shards[int(number)]), 0
    return specs.evaluate_work, evaluate_fields(job, shared), 0


def _training(
    job: Job, shared: Shared, name: str, *, views: tuple[int, ...], initial: Path | None, **fields: Any
) -> Prepared:
    path = job.folder.checkpoint(name)
    saved = path if path.exists() else None
    fields |= {
        "name": name,
        "views": views,
        "initial": initial,
        "scene": shared.scene,
        "width": job.width,
        "iterations": job.config.iterations,
        "config": job.config,
        "seed": job.config.seed,
        "device": job.config.device,
        "checkpoint": saved,
        "locate": shared.locate(views, *filter(None, (initial, saved))),
    }
    return specs.train_work, fields, checkpoint.iteration_of(saved) if saved else 0


def score_fields(job: Job, shared: Shared, name: str, views: tuple[int, ...]) -> dict[str, Any]:
    """What `work.score_work` needs."""
    model = job.folder.model("coarse")
    return {
        "name": name,
        "scene": shared.scene,
        "views": views,
        "width": job.width,
        "gaussians": model,
        "labels": shared.labels,
        "blocks": job.config.grid.count,
        "config": job.config,
        "device": job.config.device,
        "locate": shared.locate(views, model),
    }


def evaluate_fields(job: Job, shared: Shared) -> dict[str, Any]:
    """What `work.evaluate_work` needs for the merged model."""
    return {
        "scene": shared.scene,
        "views": job.scene.test,
        "width": job.width,
        "gaussians": job.folder.point_cloud,
        "near": job.near,
        "crop_bottom": job.config.eval.crop_bottom,
        "device": job.config.device,
        "locate": shared.locate(job.scene.test, job.folder.point_cloud),
    }


def new_evaluation(job: Job) -> Evaluation:
    """An empty evaluation of the merged model."""
    folder, crop = job.folder, job.config.eval.crop_bottom
    return Evaluation(job.scene, folder.point_cloud, job.width, crop, folder.images)
