"""Passes over the blocks' union, and the merge of a run whose blocks have not all been trained."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from panolog.orchestrator.engine.stages import merging
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import ModelSaved, Noticed
from panolog.orchestrator.runs.state import RunState
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, Plan, make_plan, read_plan
from panolog.partition.regions import Region, Regions
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply, read_ply_chunks, write_ply
from panolog.workers.events import Event
from panolog.workers.merge import retained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, EVAL, Stage, TaskId
from panolog.workers.training.recipes import RECIPES
from panolog.workers.training.schedule import Schedule
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import DIED, CrashError, Harness, begins, fails, well

ROUNDS = [TaskId.round(0), TaskId.round(1)]
REPAIR = TaskId.repair(0)


def passing(folder: Path, **settings: Any) -> Harness:
    """Two blocks of two cameras each, with both passes."""
    folder.mkdir(exist_ok=True)
    partition = {"min_cameras": 2, "rho_tri": 0.5}
    passes = {"round": 0.5, "repair": 0.25, "reach": 0.5}
    return Harness(folder, partition=partition, iterations=40, retries=0, **{"passes": passes, **settings})


def test_a_round_and_a_repair_start_from_the_union_before_them_and_are_merged(tmp_path: Path) -> None:
    harness = passing(tmp_path)
    assert harness.drive().outcome == "done"
    assert harness.tasks[-4:] == [*ROUNDS, REPAIR, EVAL]
    (again,), (repair,) = harness.trainings(ROUNDS[0]), harness.trainings(REPAIR)
    assert again.initial is not None and repair.initial is not None
    first, second = (read_ply(harness.folder.model(TaskId.union(number))) for number in (0, 1))
    torch.testing.assert_close(again.initial.load().sh0, first.sh0)
    torch.testing.assert_close(repair.initial.load().sh0, second.sh0)
    assert (again.iterations, repair.iterations) == (20, 10)
    plan = read_plan(harness.folder.plan)
    assert again.views == plan.cameras(0)
    assert set(repair.views) == {*plan.cameras(0), *plan.cameras(1)}
    assert isinstance(repair.cell, Region)
    unions = [record.task for record in harness.records(ModelSaved) if record.task.stage is Stage.UNION]
    assert unions == [TaskId.union(0), TaskId.union(1)]
    # The merged model has every Gaussian once as it was trained last, each time brighter by one.
    coarse, merged = read_ply(harness.folder.model(COARSE)), read_ply(harness.folder.point_cloud)
    near = repair.cell.contains(coarse.means[coarse.scene].numpy())
    assert 0 < near.sum() < len(near)
    expected = coarse.sh0[coarse.scene, 0, 0] + 2 + torch.from_numpy(near)
    order, found = coarse.means[coarse.scene, 0].argsort(), merged.means[merged.scene, 0].argsort()
    torch.testing.assert_close(merged.sh0[merged.scene, 0, 0][found], expected[order])
    torch.testing.assert_close(merged.sh0[merged.scene.stop :], coarse.sh0[coarse.scene.stop :])


@pytest.mark.parametrize("task", [ROUNDS[1], REPAIR], ids=str)
def test_what_fails_in_a_pass_stays_as_it_was(tmp_path: Path, task: TaskId) -> None:
    harness, whole = passing(tmp_path / "failed"), passing(tmp_path / "whole")
    whole.drive()
    with pytest.raises(Exception, match=f"stays as it was: {task}"):
        harness.drive(fails(task, DIED, 9))
    models = [read_ply(each.folder.point_cloud) for each in (harness, whole)]
    assert len(models[0]) == len(models[1])
    assert models[0].sh0.sum() < models[1].sh0.sum()
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.folder.point_cloud.read_bytes() == whole.folder.point_cloud.read_bytes()


def test_a_block_that_is_tried_again_is_in_all_that_follows(tmp_path: Path) -> None:
    """Also a checkpoint of a pass over the former union does not count, nor what was measured."""
    stage2 = {"exterior": "frozen", "detail": 2.0}
    harness, whole = (passing(tmp_path / name, stage2=stage2) for name in ("failed", "whole"))
    whole.drive()
    with pytest.raises(Exception, match="block 1 failed"):
        harness.drive(begins(REPAIR, CrashError(DIED), times=9, rest=fails(TaskId.block(1), DIED, 9)))
    left = harness.folder.checkpoint(REPAIR)
    left.write_bytes(harness.folder.model(COARSE).read_bytes())
    assert harness.drive(resumed=True).outcome == "done"
    assert harness.tasks == [TaskId.block(1), *ROUNDS, REPAIR, TaskId.measure(0), TaskId.measure(1)]
    assert harness.trainings(REPAIR)[0].checkpoint is None
    for made in ("point_cloud", "metrics", "seams"):
        assert getattr(harness.folder, made).read_bytes() == getattr(whole.folder, made).read_bytes()


def test_with_levels_of_detail_a_repair_has_both_blocks_whole(tmp_path: Path) -> None:
    stage2 = {"exterior": "baked", "detail": 2.0}
    harness, starts = passing(tmp_path, stage2=stage2), dict[TaskId, int]()

    def script(spec: TaskSpec) -> Iterator[Event]:
        if isinstance(spec, TrainSpec) and spec.initial is not None and spec.cell is not None:
            model = spec.initial.load()
            starts[spec.task] = int(spec.cell.contains(model.means[model.scene].numpy()).sum())
        yield from well(spec)

    assert harness.drive(script).outcome == "done"
    (repair,) = harness.trainings(REPAIR)
    union = read_ply(harness.folder.model(TaskId.union(1)))
    assert repair.cell is not None
    assert starts[REPAIR] == repair.cell.contains(union.means[union.scene].numpy()).sum() > 0
    assert not harness.folder.initial(REPAIR).exists()
    assert all(notice.task != REPAIR for notice in harness.records(Noticed))


@pytest.mark.parametrize("iterations", [1_000, 30_000, 200_000])
@pytest.mark.parametrize("recipe", RECIPES)
def test_a_pass_has_low_rates_and_adds_nothing(iterations: int, recipe: str) -> None:
    given = {"recipe": recipe, "iterations": iterations}
    config = RunConfig.model_validate(given | {"passes": {"repair": 0.1, "rate": 0.5, "position": 0.2}})
    later = config.later(Stage.REPAIR)
    assert later.iterations == iterations / 10 and later.densify.until == 0
    block, repair = (Schedule(c, c.iterations, 1.0, refine=True).rates(1) for c in (config, later))
    assert repair.pop("means") == pytest.approx(0.2 * block.pop("means"), rel=0.05)  # decays from there
    assert repair.pop("opacities") == pytest.approx(0.5 * block.pop("opacities"), rel=0.002)  # as means
    assert repair == pytest.approx({name: 0.5 * rate for name, rate in block.items()})
    assert later.depth.w0 <= config.depth.wT


COUNT, SKY = 900, 40


def model() -> Gaussians:
    """Gaussians all over a place, each of another colour, the last of them sky."""
    random = torch.Generator().manual_seed(0)
    rows = COUNT + SKY
    found = Gaussians(
        means=20 * torch.rand(rows, 3, generator=random) - 10,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(rows, 1),
        scales=torch.rand(rows, 3, generator=random),
        opacities=torch.randn(rows, generator=random),
        sh0=torch.arange(rows).float()[:, None, None].repeat(1, 1, 3),
        shN=torch.rand(rows, 15, 3, generator=random),
        sky=SKY,
    )
    found.opacities[5] = -torch.inf
    return found


def planned(folder: RunFolder, coarse: Gaussians, grid: Grid) -> Plan:
    """The plan of a run whose Stage I model is written."""
    means, centers = coarse.means[coarse.scene].numpy(), np.array([[-2.0, 0, 0], [2.0, 0, 1], [0, 1, -1]])
    folder.model(COARSE).parent.mkdir()
    write_ply(folder.model(COARSE), coarse)
    scores = np.ones((3, grid.count))
    return make_plan(centers, means, scores, grid, PartitionConfig(), rows=(0, 1, 2), names=("a", "b", "c"))


def test_blocks_that_keep_stage_one_are_cut_out_in_one_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The Stage I model was read once for each block that keeps it."""
    coarse, folder = model(), RunFolder(tmp_path)
    plan, looks = planned(folder, coarse, Grid((4, 3, 1))), list[Path]()

    def look(path: Path) -> Iterator[Gaussians]:
        looks.append(path)
        return read_ply_chunks(path)

    monkeypatch.setattr(merging, "read_ply_chunks", look)
    merging.merge_run(folder, RunState(), plan, Regions(plan.aabb, plan.grid, (), reach=0.0))
    assert looks == [folder.model(COARSE)]
    kept = [block for block in range(12) if plan.gaussians[block]]
    assert len(kept) > 4
    for block in kept:
        expected = retained(coarse, plan.cell(block), 0.0)
        found = read_ply(folder.kept(block))
        assert all(torch.equal(found.tensors()[name], it) for name, it in expected.tensors().items())
    whole = read_ply(folder.point_cloud)
    assert sorted(whole.sh0[:, 0, 0].tolist()) == [row for row in range(COUNT + SKY) if row != 5]
    assert torch.equal(whole.sh0[-SKY:], coarse.sh0[-SKY:])


def test_a_position_that_is_not_finite_is_an_error(tmp_path: Path) -> None:
    coarse, folder = model(), RunFolder(tmp_path)
    plan = planned(folder, coarse, Grid((2, 1, 1)))
    coarse.means[7, 1] = torch.nan
    write_ply(folder.model(COARSE), coarse)
    with pytest.raises(RunError, match="the Stage I model cannot be cut"):
        merging.merge_run(folder, RunState(), plan, Regions(plan.aabb, plan.grid, (), reach=0.0))
