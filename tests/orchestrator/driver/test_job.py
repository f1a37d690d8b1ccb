"""The spec of a task names its own files and no others."""

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from panolog.orchestrator.driver.job import Job, Specs
from panolog.orchestrator.resources.pool import InProcess
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.partition.faces import Plane
from panolog.scene.files import Locate, here
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.specs import ModelFile
from panolog.workers.tasks import COARSE, EVAL, TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.workers.small import WIDTH, small_scene

BLOCK = (1, 3)  # the cameras of block 0
OTHERS = (2, 0)  # those that see it besides
CELL = Cell(aabb(np.eye(3), 2.0), Grid((1, 1, 1)), 0)


class Offer(InProcess):
    """Takes the place of a pool, and notes which files tasks are given."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        (folder / "scene").mkdir()
        self.job = Job(
            RunFolder(folder / "run"), small_scene(folder / "scene"), RunConfig(width=WIDTH, **settings)
        )
        self.scene: set[Path] = set()
        self.run: set[Path] = set()
        self.specs = Specs(self.job, self)
        plan = SimpleNamespace(
            cameras=lambda _: BLOCK, cell=lambda _: CELL, compared=lambda _, n: (*BLOCK[:n], *OTHERS[:n])
        )
        vars(self.specs).update(plan=plan, faces=(), _labels=())  # as if Stage I were done

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        self.scene, self.run = set(scene), set(run)
        return here

    def images(self, rows: Iterable[int]) -> set[Path]:
        return {file for row in rows for file in self.job.scene.panoramas[row].files}


@pytest.fixture
def offer(tmp_path: Path) -> Offer:
    return Offer(tmp_path, device="cpu", recipe="paper")


def test_stage_one_gets_all_panoramas_to_train_on(offer: Offer) -> None:
    offer.specs.of(COARSE)
    assert offer.scene == offer.images(offer.job.scene.train)
    assert offer.run == set()


def test_a_block_gets_its_own_panoramas_and_the_coarse_model(offer: Offer) -> None:
    spec = offer.specs.of(TaskId.block(0))
    coarse = offer.job.folder.model(COARSE)
    assert offer.scene == offer.images(BLOCK)
    assert isinstance(spec, TrainSpec)
    assert (spec.initial, offer.run) == (ModelFile(coarse), {coarse})
    assert (spec.cell, spec.views, spec.compared) == (CELL, BLOCK, ())


def test_a_block_also_gets_the_panoramas_that_it_is_compared_on(tmp_path: Path) -> None:
    offer = Offer(tmp_path, device="cpu", stage2={"compare": 1})
    spec = offer.specs.of(TaskId.block(0))
    assert isinstance(spec, TrainSpec) and spec.compared == (1, 2)
    assert offer.scene == offer.images((*BLOCK, 2))


def test_a_shard_gets_its_own_panoramas_and_the_coarse_model(offer: Offer) -> None:
    offer.specs.of(TaskId.shard(0))
    assert offer.scene == offer.images(offer.job.shards[0])
    assert offer.run == {offer.job.folder.model(COARSE)}


def test_the_evaluation_gets_the_held_out_panoramas_and_the_merged_model(offer: Offer) -> None:
    offer.specs.of(EVAL)
    assert offer.scene == offer.images(offer.job.scene.test)
    assert offer.run == {offer.job.folder.point_cloud}


def test_an_evaluation_of_seams_also_gets_the_training_panoramas_and_the_coarse_model(offer: Offer) -> None:
    faces = (Plane(0, 1, 0, 0.5, (0.5, 0.0, 0.0), (0.5, 1.0, 1.0)),)
    vars(offer.specs).update(faces=faces)
    spec = offer.specs.of(EVAL)
    assert isinstance(spec, EvaluateSpec) and spec.seams is not None
    assert spec.seams.faces == faces
    assert offer.scene == offer.images((*offer.job.scene.test, *offer.job.scene.train))
    assert offer.run == {offer.job.folder.point_cloud, offer.job.folder.model(COARSE)}


def test_an_evaluation_fits_poses_where_stage_one_has_refined_them(offer: Offer) -> None:
    spec, test = offer.specs.of(EVAL), offer.job.scene.test
    assert isinstance(spec, EvaluateSpec) and spec.pose_fit is None
    assert not len(spec.scene.load().points)
    offer.job.folder.root.mkdir(exist_ok=True)
    offer.job.folder.poses.write_text("{}")
    spec = offer.specs.of(EVAL)
    assert isinstance(spec, EvaluateSpec) and spec.pose_fit == offer.job.config.loss.lambda_ssim
    scene = spec.scene.load()
    for row in test:
        panorama, known = scene.panoramas[row], offer.job.scene.panoramas[row]
        assert len(panorama.observed)
        assert (scene.points[panorama.observed] == offer.job.scene.points[known.observed]).all()
