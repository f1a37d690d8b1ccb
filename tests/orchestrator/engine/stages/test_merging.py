"""The merge of a run whose blocks have not all been trained: they keep what Stage I has in their cells."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from panolog.orchestrator.engine.stages import merging
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.state import RunState
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan
from panolog.partition.regions import Regions
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply, read_ply_chunks, write_ply
from panolog.workers.merge import retained
from panolog.workers.tasks import COARSE

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


def test_blocks_that_keep_stage_one_are_cut_out_in_one_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The Stage I model was read once for each block that keeps it."""
    coarse, folder = model(), RunFolder(tmp_path)
    means, centers = coarse.means[coarse.scene].numpy(), np.array([[-2.0, 0, 0], [2.0, 0, 1], [0, 1, -1]])
    options = {"rows": (0, 1, 2), "names": ("a", "b", "c")}
    plan = make_plan(centers, means, np.ones((3, 12)), Grid((4, 3, 1)), PartitionConfig(), **options)  # type: ignore[arg-type]
    folder.model(COARSE).parent.mkdir()
    write_ply(folder.model(COARSE), coarse)
    looks = list[Path]()

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
    centers, means = np.eye(3), coarse.means[coarse.scene].numpy()
    options = {"rows": (0, 1, 2), "names": ("a", "b", "c")}
    plan = make_plan(centers, means, np.ones((3, 2)), Grid((2, 1, 1)), PartitionConfig(), **options)  # type: ignore[arg-type]
    coarse.means[7, 1] = torch.nan
    folder.model(COARSE).parent.mkdir()
    write_ply(folder.model(COARSE), coarse)
    with pytest.raises(RunError, match="the Stage I model cannot be cut"):
        merging.merge_run(folder, RunState(), plan, Regions(plan.aabb, plan.grid, (), reach=0.0))
