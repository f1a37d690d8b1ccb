"""The spec of a task names its own files and no others."""

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csc_array

from panolog.orchestrator.engine.driver.job import Job, Specs
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.partition.faces import Plane
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.specs import ModelFile
from panolog.workers.tasks import COARSE, EVAL, TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Noting
from tests.workers.small import WIDTH, small_scene

BLOCK = (1, 3)  # the cameras of block 0
OTHERS = (2, 0)  # those that see it besides
SCORES = [0.5, 1.0, 0.0, 2.0]  # of block 0
CELL = Cell(aabb(np.eye(3), 2.0), Grid((1, 1, 1)), 0)
FACES = (Plane(0, 1, 0, 0.5, (0.5, 0.0, 0.0), (0.5, 1.0, 1.0)),)


class Offer(Noting):
    """The files and specs of a job whose Stage I and plan are done."""

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


@pytest.fixture
def offer(tmp_path: Path) -> Offer:
    return Offer(tmp_path)


def test_each_task_gets_its_own_panoramas_and_the_model_that_it_needs(offer: Offer) -> None:
    scene, merged = offer.job.scene, offer.job.folder.point_cloud
    for task, rows, made in (
        (COARSE, scene.train, set[Path]()),
        (TaskId.shard(0), offer.job.shards[0], {offer.coarse}),
        (TaskId.block(0), BLOCK, {offer.coarse}),
        (EVAL, scene.test, {merged}),
    ):
        offer.specs.of(task)
        assert (offer.scene, offer.run) == (offer.images(rows), made), task
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
    assert offer.scene == offer.images((*BLOCK, *compared))
