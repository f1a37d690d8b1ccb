"""A job and the specs of its tasks."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from typing_extensions import assert_never

from panolog.orchestrator.engine.driver import policy
from panolog.orchestrator.engine.estimates.place_parts import districts_of
from panolog.orchestrator.engine.scheduling.pool import Sharing
from panolog.orchestrator.engine.stages.evaluation import Evaluation
from panolog.orchestrator.engine.stages.first_look import shown_row
from panolog.orchestrator.engine.stages.partitioning import block_labels
from panolog.orchestrator.engine.stages.scenes import learnt_scene
from panolog.orchestrator.engine.stages.surroundings import Surroundings
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.state import RunState
from panolog.partition.cells import Volume
from panolog.partition.districts import Districts
from panolog.partition.faces import Plane, most_seen, seams_of, views_at
from panolog.partition.plan import Plan, read_plan
from panolog.partition.regions import Regions
from panolog.partition.scores import read_scores
from panolog.scene.files import Locate
from panolog.scene.model import Scene
from panolog.scene.ply import read_scene_means
from panolog.workers.evaluation import FACES, EvaluateSpec
from panolog.workers.scoring import ScoreSpec, in_shards, shards_of
from panolog.workers.seams.cameras import Looks
from panolog.workers.seams.measurement import Seams
from panolog.workers.specs import ModelFile, ScenePart, Source
from panolog.workers.tasks import COARSE, EVAL, Stage, TaskId
from panolog.workers.training.checkpoint import CheckpointFile
from panolog.workers.training.initialise import near_distance
from panolog.workers.training.trainer import TrainSpec


@dataclass(frozen=True, eq=False)
class Job:
    """A scene, what to do with it, and where."""

    folder: RunFolder
    scene: Scene
    config: RunConfig  # resolved: `width` and `device` are those in use

    @property
    def learnt(self) -> "Job":
        """This job with what Stage I has learnt about how the panoramas were captured."""
        return replace(self, scene=learnt_scene(self.folder, self.scene))

    @property
    def width(self) -> int:
        """Pixels of the panoramas in training and evaluation."""
        return self.config.width or self.scene.width

    @cached_property
    def shards(self) -> tuple[tuple[int, ...], ...]:
        """The training cameras as they are scored."""
        return shards_of(self.scene.train, self.config.stage2.reduces)

    @cached_property
    def districts(self) -> Districts | None:
        """The parts of the place whose Stage I is trained apart; None where it is trained as one."""
        return None if self.config.districts == 1 else districts_of(self.scene, self.config)

    def district(self, task: TaskId) -> Volume | None:
        """Where a district keeps its Gaussians; None for Stage I as one."""
        if self.districts is None or task.stage is not Stage.DISTRICT:
            return None
        return self.districts.cell(task.number)

    def start(self, task: TaskId) -> TaskId:
        """The task whose model of the whole place one that refines a part of it starts from."""
        if task.stage is Stage.BLOCK:
            return COARSE
        return TaskId.union(self.config.passes.stages.index(task.stage))

    def ready(self, state: RunState) -> tuple[TaskId, ...]:
        """The tasks that may start now: `policy.ready`."""
        return policy.ready(
            state,
            shards=len(self.shards),
            refine=self.config.refine,
            districts=1 if self.districts is None else self.districts.count,
            deliver=self.config.deliver,
        )

    def views(self, task: TaskId) -> tuple[int, ...]:
        """The rows of the scene's panoramas that train a district, or Stage I as one."""
        train = self.scene.train
        if self.districts is None or task.stage is not Stage.DISTRICT:
            return train
        return tuple(np.array(train)[self.districts.cameras[task.number]].tolist())

    @cached_property
    def near(self) -> float:
        """World units nearer than which nothing is drawn."""
        return near_distance(self.scene, self.config)


_WORTH = 32  # Gaussians of Stage I near a face from which on they are worth a task


class Specs:
    """Makes the specs of a job's tasks, and the files that they need besides what the run has.

    What several of them share is read and put once.
    """

    def __init__(self, job: Job, sharing: Sharing) -> None:
        self.job = job  # with the scene that the specs are of
        self._sharing = sharing
        self._known: dict[tuple[Path, int, int, float | None], Surroundings] = {}

    def of(self, task: TaskId) -> TrainSpec | ScoreSpec | EvaluateSpec:
        """The spec of a task.

        Raises ValueError for the plan, the merge and the delivery, which the driver makes itself, OSError if
        the disk takes no file.
        """
        match task.stage:
            case Stage.DISTRICT | Stage.COARSE:
                return self._train(task, self.job.views(task), district=self.job.district(task))
            case Stage.SCORE:
                views, reduces = self.job.shards[task.number], self.job.config.stage2.reduces
                return self._reduced(task, views) if reduces else self.score(task, views)
            case Stage.BLOCK | Stage.ROUND:
                block = task.number
                views, cell = self.plan.cameras(block), self.plan.cell(block)
                compared = self._compared(block, self.job.config.stage2.compare)
                initial = self._initial(task, (block,), (*views, *compared))
                return self._train(task, views, initial, cell, compared=compared)
            case Stage.REPAIR:
                return self._repair(task)
            case Stage.MEASURE:
                return self._measure(task)
            case Stage.EVAL:
                crop = self.job.config.eval.crop_bottom
                return self.evaluate(self.job.folder.point_cloud, crop, self.faces)
            case Stage.PREPARE | Stage.CALIBRATE | Stage.PLAN | Stage.UNION | Stage.MERGE | Stage.DELIVER:
                raise ValueError(f"{task} is not a task of a worker")
            case _:
                assert_never(task.stage)

    def score(self, task: TaskId, views: tuple[int, ...]) -> ScoreSpec:
        """The scores of some cameras with the Stage I model."""
        return self._scored(task, views, self.job.folder.model(COARSE), self._labels)

    def _scored(
        self, task: TaskId, views: tuple[int, ...], model: Path, labels: Source[NDArray[np.int64]]
    ) -> ScoreSpec:
        job, locate = self.job, self._locate(views, model)
        return ScoreSpec(
            task=task,
            scene=self._part(views),
            views=views,
            width=job.width,
            model=ModelFile(model, locate),
            labels=labels,
            blocks=job.config.grid.count,
            config=job.config,
            device=job.config.device,
            locate=locate,
        )

    def evaluate(self, model: Path, crop_bottom: float, faces: tuple[Plane, ...] = ()) -> EvaluateSpec:
        """The evaluation of a model, given as a PLY, on the held-out panoramas.

        Args: faces of the plan whose seams are measured too.
        """
        scene, coarse = self.job.scene, self.job.folder.model(COARSE) if faces else None
        locate = self._locate((*scene.test, *(scene.train if faces else ())), *filter(None, (model, coarse)))
        seams = Seams(faces, self._plan, ModelFile(coarse, locate)) if coarse else None
        return self._evaluation(EVAL, scene.test, ModelFile(model, locate), seams, crop_bottom)

    def _evaluation(
        self, task: TaskId, views: tuple[int, ...], model: ModelFile, seams: Seams | None, crop_bottom: float
    ) -> EvaluateSpec:
        job = self.job
        refined = job.folder.poses.exists() and bool(views)
        return EvaluateSpec(
            task=task,
            scene=ScenePart(self._panoramas, job.scene.cloud_of(views)) if refined else self._panoramas,
            views=views,
            width=job.width,
            model=model,
            near=job.near,
            crop_bottom=crop_bottom,
            damaged=job.config.images.damaged,
            seams=seams,
            pose_fit=job.config.loss.lambda_ssim if refined else None,
            device=job.config.device,
            locate=model.locate,
        )

    def _measure(self, task: TaskId) -> EvaluateSpec:
        """A shard of the evaluation, with levels of detail as fine as no metric shows."""
        job, folder, (views, faces) = self.job, self.job.folder, self.measures[task.number]
        looks = Looks.of(job.scene, self.plan, faces) if faces else Looks({}, {})
        models = {folder.seen(task): folder.point_cloud}
        if faces:
            models[folder.seen_coarse(task)] = folder.model(COARSE)
        centers = np.concatenate([job.scene.centers[list(views)], looks.centers])
        folder.make(folder.seen(task).parent)
        of_models = self._surroundings(*models.values(), detail=job.config.measured_detail)
        for path, surroundings in zip(models, of_models, strict=True):
            surroundings.write_seen(path, centers)
        locate = self._locate((*views, *looks.rows), *models)
        seen = [ModelFile(path, locate) for path in models]
        seams = Seams(faces, self._plan, seen[1]) if faces else None
        return self._evaluation(task, views, seen[0], seams, job.config.eval.crop_bottom)

    @cached_property
    def faces(self) -> tuple[Plane, ...]:
        """The faces whose seams are measured."""
        config = self.job.config
        planned = config.refine and self.job.folder.plan.exists()  # a run that has ended early may have none
        return most_seen(self.plan, self._seams, config.eval.seams) if planned else ()

    @cached_property
    def measures(self) -> tuple[tuple[tuple[int, ...], tuple[Plane, ...]], ...]:
        """The held-out panoramas or the faces of each shard of the evaluation; none where it is one task."""
        if self.job.config.measured_detail is None:
            return ()
        views = ((rows, ()) for rows in shards_of(self.job.scene.test, reduces=True))
        return (*views, *(((), faces) for faces in in_shards(self.faces, FACES)))

    @cached_property
    def repaired(self) -> Regions:
        """What is near faces, each of which is trained once more if the settings have it."""
        plan, passes = self.plan, self.job.config.passes
        faces = self._seams if passes.repair else ()
        return Regions(plan.aabb, plan.grid, faces, passes.reach * plan.baseline)

    @cached_property
    def _seams(self) -> tuple[Plane, ...]:
        return seams_of(self.plan)

    def passes(self) -> tuple[tuple[str, ...], ...]:
        """The tasks of each pass over the blocks' union."""
        blocks = np.flatnonzero(self.plan.trained).tolist()
        tasks = {Stage.ROUND: lambda: map(TaskId.round, blocks), Stage.REPAIR: self._repairs}
        found = (tuple(map(str, tasks[stage]())) for stage in self.job.config.passes.stages)
        return tuple(filter(None, found))

    def _repairs(self) -> Iterator[TaskId]:
        near = self.repaired
        sizes = np.bincount(near.of(self.means), minlength=len(near.faces))
        return map(TaskId.repair, np.flatnonzero(sizes[: len(near.faces)] >= _WORTH).tolist())

    @cached_property
    def means(self) -> NDArray[np.float32]:
        """(N, 3) of the scene Gaussians of the Stage I model."""
        return read_scene_means(self.job.folder.model(COARSE))

    @cached_property
    def plan(self) -> Plan:
        """The partition, here."""
        return read_plan(self.job.folder.plan)

    def _compared(self, block: int, count: int) -> tuple[int, ...]:
        """At most so many panoramas that train a block, and as many others, on which it is compared."""
        if not count:
            return ()
        return self.plan.compared(block, self._scores[:, [block]].toarray()[:, 0], count)

    @cached_property
    def _scores(self) -> csc_array:
        """(K, B) of the plan: read here, and only to compare blocks."""
        return read_scores(self.job.folder.scores, self.plan.rows, self.plan.grid.count).tocsc()

    def _part(self, rows: tuple[int, ...]) -> Source[Scene]:
        scene = self.job.scene
        if len(rows) >= len(scene.train):
            return self._whole
        return ScenePart(self._panoramas, scene.cloud_of(rows))

    @cached_property
    def _whole(self) -> Source[Scene]:
        return self._sharing.put(self.job.scene)

    @cached_property
    def _panoramas(self) -> Source[Scene]:
        return self._sharing.put(self.job.scene.without_points())

    @cached_property
    def _plan(self) -> Source[Plan]:
        return self._sharing.put(self.plan)

    @cached_property
    def _labels(self) -> Source[NDArray[np.int64]]:
        return self._sharing.put(block_labels(self.job.scene, self.means, self.job.config))

    def _surroundings(self, *models: Path, detail: float | None = None) -> list[Surroundings]:
        """The surroundings by models of the whole place, as their files are now; the last ones are kept."""
        job, wanted = self.job, dict[tuple[Path, int, int, float | None], Path]()
        for path in models:
            now = path.stat()
            wanted[path, now.st_ino, now.st_mtime_ns, detail] = path
        self._known = {key: known for key, known in self._known.items() if key in wanted}
        for key, path in wanted.items():  # after the files of others are gone
            if key not in self._known:
                self._known[key] = Surroundings(job.scene, path, job.config, job.width, detail)
        return [self._known[key] for key in wanted]

    def _reduced(self, task: TaskId, views: tuple[int, ...]) -> ScoreSpec:
        """The shard of scores with levels of detail of the Stage I model."""
        job, path = self.job, self.job.folder.seen(task)
        job.folder.make(path.parent)
        (surroundings,) = self._surroundings(job.folder.model(COARSE))
        labels = self._sharing.put(surroundings.write_seen(path, job.scene.centers[list(views)]))
        return replace(self._scored(task, views, path, labels), sizes=surroundings.sizes)

    def _repair(self, task: TaskId) -> TrainSpec:
        """What is near a face, on the panoramas of both of its blocks that are near it too."""
        face, compare = self.repaired.faces[task.number], self.job.config.stage2.compare
        views, checks = views_at(self.plan, face, compare)
        initial = self._initial(task, (face.below, face.above), (*views, *checks))
        return self._train(task, views, initial, self.repaired.margin(task.number), compared=checks)

    def _initial(self, task: TaskId, blocks: tuple[int, ...], views: tuple[int, ...]) -> Path:
        """The model that a task starts from. Args: blocks that it trains, or parts of; views it renders."""
        folder, whole = self.job.folder, self.job.start(task)
        if not self.job.config.stage2.reduces:
            return folder.model(whole)
        path = folder.initial(task)
        if not path.exists():
            folder.make(path.parent)
            (surroundings,) = self._surroundings(folder.model(whole))
            surroundings.write(path, blocks, views)
        return path

    def _train(
        self,
        task: TaskId,
        views: tuple[int, ...],
        initial: Path | None = None,
        cell: Volume | None = None,
        *,
        compared: tuple[int, ...] = (),
        district: Volume | None = None,
    ) -> TrainSpec:
        job, path = self.job, self.job.folder.checkpoint(task)
        config = job.config.later(task.stage) if task.stage in job.config.passes.stages else job.config
        saved, shown = path if path.exists() else None, shown_row(self.job.scene, cell or district)
        locate = self._locate((*views, *compared), *filter(None, (initial, saved)), shown=shown)
        return TrainSpec(
            task=task,
            scene=self._part((*views, *compared)),
            views=views,
            width=job.width,
            iterations=config.iterations,
            config=config,
            seed=config.seed,
            device=config.device,
            initial=ModelFile(initial, locate) if initial else None,
            cell=cell,
            district=district,
            compared=compared,
            shown=shown,
            checkpoint=CheckpointFile(saved, locate) if saved else None,
            locate=locate,
        )

    def _locate(self, views: Iterable[int], *made: Path, shown: int | None = None) -> Locate:
        panoramas = self.job.scene.panoramas
        picture = [] if shown is None else [panoramas[shown].image]
        files = (file for row in views for file in panoramas[row].files)
        return self._sharing.share_files((*files, *picture), made)


def new_evaluation(
    job: Job, faces: int, rows: tuple[int, ...] | None = None, detail: float | None = None
) -> Evaluation:
    """An empty evaluation of the merged model. Args: as the fields of `Evaluation`."""
    folder, crop = job.folder, job.config.eval.crop_bottom
    return Evaluation(job.scene, folder.point_cloud, job.width, crop, folder, faces, rows, detail)
