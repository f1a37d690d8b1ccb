"""What a task is given: its own files and no others, named and not carried."""

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import pytest

from panolog.orchestrator.driver.job import Job, Shared, prepare
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.files import Locate, here
from tests.workers.small import WIDTH, small_scene

BLOCK = (1, 3)  # the cameras of block 0


class Offer:
    """Takes the place of a pool, and notes which files tasks are given."""

    def __init__(self, folder: Path) -> None:
        (folder / "scene").mkdir()
        self.job = Job(
            RunFolder(folder / "run"), small_scene(folder / "scene"), RunConfig(width=WIDTH, device="cpu")
        )
        self.scene: set[Path] = set()
        self.run: set[Path] = set()
        self.shared = Shared(self.job, lambda value: value, self.share)
        plan = SimpleNamespace(cameras=lambda _: BLOCK, cell=lambda _: None)
        vars(self.shared).update(plan=plan, labels=())  # as if Stage I were done

    def share(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        self.scene, self.run = set(scene), set(run)
        return here

    def images(self, rows: Iterable[int]) -> set[Path]:
        return {file for row in rows for file in self.job.scene.panoramas[row].files}


@pytest.fixture
def offer(tmp_path: Path) -> Offer:
    return Offer(tmp_path)


def test_stage_one_gets_all_panoramas_to_train_on(offer: Offer) -> None:
    prepare(offer.job, offer.shared, "coarse")
    assert offer.scene == offer.images(offer.job.scene.train)
    assert offer.run == set()


def test_a_block_gets_its_own_panoramas_and_the_coarse_model(offer: Offer) -> None:
    _, fields, _ = prepare(offer.job, offer.shared, "block/000")
    coarse = offer.job.folder.model("coarse")
    assert offer.scene == offer.images(BLOCK)
    assert (fields["initial"], offer.run) == (coarse, {coarse})


def test_a_shard_gets_its_own_panoramas_and_the_coarse_model(offer: Offer) -> None:
    prepare(offer.job, offer.shared, "score/000")
    assert offer.scene == offer.images(offer.job.shards[0])
    assert offer.run == {offer.job.folder.model("coarse")}


def test_the_evaluation_gets_the_held_out_panoramas_and_the_merged_model(offer: Offer) -> None:
    prepare(offer.job, offer.shared, "eval")
    assert offer.scene == offer.images(offer.job.scene.test)
    assert offer.run == {offer.job.folder.point_cloud}
