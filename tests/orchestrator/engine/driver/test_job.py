"""What tasks get and demand: their files and no others, their image cache and memory."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_array

from panolog.orchestrator.engine.driver.demands import Sizes, image_cache
from panolog.orchestrator.engine.driver.job import Job, Specs
from panolog.orchestrator.engine.estimates import estimate
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.orchestrator.runs.records import BlockPlan, Merged
from panolog.orchestrator.runs.state import RunState
from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.partition.faces import Plane
from panolog.scene.ply import write_ply
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.growth_law import Period, population
from panolog.workers.specs import ModelFile
from panolog.workers.tasks import COARSE, EVAL, TaskId
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.task_config import CacheConfig
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Noting
from tests.workers.small import WIDTH, small_scene

BLOCK = (1, 3)  # the cameras of block 0
OTHERS = (2, 0)  # those that see it besides
SCORES = [0.5, 1.0, 0.0, 2.0]  # of block 0
CELL = Cell(aabb(np.eye(3), 2.0), Grid((1, 1, 1)), 0)
FACES = (Plane(0, 1, 0, 0.5, (0.5, 0.0, 0.0), (0.5, 1.0, 1.0)),)


class Offer(Noting):
    def __init__(self, folder: Path, **settings: Any) -> None:
        super().__init__()
        (folder / "scene").mkdir()
        config = RunConfig(width=WIDTH, device="cpu", recipe="paper", **settings)
        self.job = Job(RunFolder(folder / "run"), small_scene(folder / "scene"), config)
        self.coarse = self.job.folder.model(COARSE)
        self.specs = Specs(self.job, self)
        plan = SimpleNamespace(
            rows=range(4),
            cameras=lambda _: BLOCK,
            cell=lambda _: CELL,
            compared=lambda _, scores, n: (*BLOCK[:n], *OTHERS[:n]) if scores.tolist() == SCORES else (),
        )
        vars(self.specs).update(plan=plan, faces=(), _labels=(), _scores=csc_array([[it] for it in SCORES]))

    def images(self, rows: Iterable[int]) -> set[Path]:
        return {file for row in rows for file in self.job.scene.panoramas[row].files}

    @property
    def shown(self) -> set[Path]:
        return {self.job.scene.panoramas[self.job.scene.test[0]].image}


@pytest.fixture
def offer(tmp_path: Path) -> Offer:
    return Offer(tmp_path)


def test_each_task_gets_its_own_panoramas_and_the_model_that_it_needs(offer: Offer) -> None:
    """What trains also gets the picture of a held-out panorama."""
    scene, merged, nothing = offer.job.scene, offer.job.folder.point_cloud, set[Path]()
    for task, rows, made, shown in (
        (COARSE, scene.train, nothing, offer.shown),
        (TaskId.shard(0), offer.job.shards[0], {offer.coarse}, nothing),
        (TaskId.block(0), BLOCK, {offer.coarse}, offer.shown),
        (EVAL, scene.test, {merged}, nothing),
    ):
        offer.specs.of(task)
        assert (offer.scene, offer.run) == (offer.images(rows) | shown, made), task
    vars(offer.specs).update(faces=FACES)
    spec = offer.specs.of(EVAL)
    assert isinstance(spec, EvaluateSpec) and spec.seams is not None and spec.seams.faces == FACES
    assert offer.scene == offer.images((*scene.test, *scene.train))
    assert offer.run == {merged, offer.coarse}


@pytest.mark.parametrize(("compare", "compared"), [(0, ()), (1, (1, 2))])
def test_a_block_also_gets_the_panoramas_that_it_is_compared_on(
    tmp_path: Path, compare: int, compared: tuple[int, ...]
) -> None:
    offer = Offer(tmp_path, stage2={"compare": compare})
    spec = offer.specs.of(TaskId.block(0))
    assert isinstance(spec, TrainSpec) and spec.initial == ModelFile(offer.coarse)
    assert (spec.cell, spec.views, spec.compared) == (CELL, BLOCK, compared)
    assert offer.scene == offer.images((*BLOCK, *compared)) | offer.shown


class Half:
    """What is on one side of the place."""

    def __init__(self, least: float) -> None:
        self._least = least

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return points[:, 0] >= self._least


@pytest.mark.parametrize(("least", "row"), [(-9.0, 2), (0.3, 1), (0.6, None)])
def test_a_task_shows_the_most_central_held_out_panorama_of_its_part(
    offer: Offer, least: float, row: int | None
) -> None:
    """Stage I has the whole place, with more held-out panoramas than a block may have."""
    scene = replace(offer.job.scene, train=(0, 3), test=(1, 2, 4))
    offer.specs.job = replace(offer.job, scene=scene)
    offer.specs.plan.cell = lambda _: Half(least)  # type: ignore[method-assign, assignment, return-value]
    block, coarse = offer.specs.of(TaskId.block(0)), offer.specs.of(COARSE)
    assert isinstance(block, TrainSpec) and isinstance(coarse, TrainSpec)
    assert (block.shown, coarse.shown) == (row, 2)
    scene.panoramas[2].image.unlink()
    coarse = offer.specs.of(COARSE)
    assert isinstance(coarse, TrainSpec) and coarse.shown is None  # the training does without it


GIB = 2**30
NODE = Node("a", "host", cpus=16, memory=64 * GIB, gpus=(Gpu(memory=24 * GIB), Gpu(memory=24 * GIB)))
HALF = Placement("a", cpus=8.0, memory=24 * GIB, gpus=1.0, gpu=0, kind="GPU")  # one of its two GPUs
SET = CacheConfig(memory=5.0, device=1.0)
LEAST = CacheConfig().memory


@pytest.mark.parametrize(
    ("cache", "where", "memory", "need", "shortages", "expected"),
    [
        (CacheConfig(), replace(HALF, gpu=None), 64, 6, 0, (LEAST, None)),  # on the CPU the settings hold
        (SET, replace(HALF, gpu=None), 64, 6, 0, (5.0, 1.0)),
        (CacheConfig(), HALF, 64, 6, 0, (64 / 2 / 2, 0.9 * 24 - 6)),  # on a GPU, what is free
        (CacheConfig(), HALF, 64, 40, 0, (64 / 2 / 2, 0.0)),
        (CacheConfig(), HALF, 0, 6, 0, (LEAST, 0.9 * 24 - 6)),  # a small machine
        (SET, HALF, 64, 6, 0, (5.0, 1.0)),
        (SET, HALF, 64, 6, 1, (1.25, 0.0)),  # after a shortage nothing on the GPU
    ],
)
def test_the_image_cache_is_as_set_or_what_its_place_leaves(
    cache: CacheConfig,
    where: Placement,
    memory: int,
    need: int,
    shortages: int,
    expected: tuple[float, float | None],
) -> None:
    found = image_cache(cache, where, replace(NODE, memory=memory * GIB), need * GIB, shortages)
    assert (found.memory, found.device) == pytest.approx(expected)


def test_the_growth_of_few_blocks_is_forecast_for_thousands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forecasts: list[int] = []

    def counted(start: int, *rest: Any) -> list[Period]:
        forecasts.append(start)
        return population(start, *rest)

    monkeypatch.setattr(estimate, "population", counted)
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path / "run")
    folder.model(COARSE).parent.mkdir(parents=True)
    write_ply(folder.model(COARSE), scene_gaussians(scene))
    blocks = tuple(BlockPlan(i, 3, 1000 + i, train=True) for i in range(3000))
    sizes = Sizes(Job(folder, scene, RunConfig(width=WIDTH, device="cpu")))
    state = RunState(plan=blocks)
    bytes_ = [sizes.of(TaskId.block(block.block), state) for block in blocks]
    assert bytes_ == sorted(bytes_) and bytes_[0] < bytes_[-1]
    assert len(forecasts) < 100


def test_shards_demand_what_their_cameras_distinguish(tmp_path: Path) -> None:
    """Here of a cloud whose points lie where others do, so that few are enough."""
    scene, count = small_scene(tmp_path), 100_000
    folder = RunFolder(tmp_path / "run")
    folder.model(COARSE).parent.mkdir(parents=True)
    dense = replace(scene, points=scene.points.repeat(count // len(scene.points), axis=0))
    cloud = scene_gaussians(small_scene(tmp_path / "many", points=count))
    write_ply(folder.model(COARSE), cloud)
    state = RunState(merged=Merged("point_cloud.ply", count, 0, 1, 0.1))
    sizes = {}
    for detail in (0.0, 2.0):
        settings = {"width": WIDTH, "device": "cpu", "sky": {"count": 0}, "stage2": {"detail": detail}}
        config = RunConfig.model_validate(settings)
        of = Sizes(Job(folder, dense, config)).of
        sizes[detail] = [of(task, state) for task in (EVAL, TaskId.shard(0), TaskId.measure(0))]
    whole, score, measure = sizes[2.0]
    assert sizes[0.0][:2] == [whole, whole]
    assert max(score, measure) < whole - count * 300
