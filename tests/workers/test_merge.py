"""Cut and merge together: every Gaussian of the model is in the result once, sky last."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cell, Grid
from panolog.scene.errors import InputError, RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply, write_ply, write_ply_parts
from panolog.workers.merge import merge, retained
from tests.renderer.hard_scenes import cloud

BOX = Aabb(np.full(3, -1.0), np.full(3, 1.0))
GRID = Grid((2, 1, 2))


def model(count: int, sky: int) -> Gaussians:
    return replace(cloud(count), sky=sky)


def cell(block: int) -> Cell:
    return Cell(BOX, GRID, block)


def saved(path: Path, gaussians: Gaussians) -> Path:
    write_ply(path, gaussians)
    return path


def files(folder: Path, gaussians: Gaussians) -> list[Path]:
    return [
        saved(folder / f"{block}.ply", retained(gaussians, cell(block), 0.0)) for block in range(GRID.count)
    ]


def test_only_opacities_above_the_threshold_stay() -> None:
    whole = model(4, 0)
    logit = math.log(0.005 / 0.995)
    opacities = torch.tensor([logit - 1e-3, logit + 1e-3, 5.0, -20.0])
    kept = retained(replace(whole, means=torch.zeros(4, 3), opacities=opacities), cell(3), 0.005)
    torch.testing.assert_close(kept.opacities, opacities[1:3])
    none = retained(replace(whole, means=torch.zeros(4, 3), opacities=torch.full((4,), -9.0)), cell(3), 0.5)
    assert len(none) == 0


def test_a_position_that_is_not_finite_stops_the_cut() -> None:
    whole = model(4, 1)
    broken = replace(whole, means=whole.means.index_fill(0, torch.tensor([1]), math.nan))
    with pytest.raises(RunError, match=r"block 2 .* not finite"):
        retained(broken, cell(2), 0.005)


def test_merge_has_each_gaussian_once_and_sky_last(tmp_path: Path) -> None:
    whole, coarse = replace(model(300, 40), exact=True), tmp_path / "coarse.ply"
    write_ply(coarse, whole, offset=(1.0, 2.0, 3.5))
    assert merge(dict.fromkeys(files(tmp_path, whole)), coarse, tmp_path / "all.ply") == 300
    merged = read_ply(tmp_path / "all.ply")
    assert merged.sky == 40 and merged.exact
    parts = [retained(whole, cell(block), 0.0) for block in range(GRID.count)]
    assert all(part.sky == 0 for part in parts)
    together = np.concatenate([part.means.numpy() for part in parts])
    assert len(together) == 260 == len(np.unique(together, axis=0))
    parts.append(whole.select(torch.arange(300) >= 260))
    write_ply_parts(tmp_path / "expected.ply", parts, count=300, sky=40, exact=True, offset=(1.0, 2.0, 3.5))
    assert (tmp_path / "all.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()


def test_empty_blocks_and_no_sky_merge_to_an_empty_model(tmp_path: Path) -> None:
    nothing = model(0, 0)
    assert (
        merge(
            dict.fromkeys(files(tmp_path, nothing)),
            saved(tmp_path / "coarse.ply", nothing),
            tmp_path / "all.ply",
        )
        == 0
    )
    assert len(read_ply(tmp_path / "all.ply")) == 0


def test_a_block_with_sky_is_refused(tmp_path: Path) -> None:
    block = saved(tmp_path / "block.ply", model(10, 4))
    with pytest.raises(RunError, match="4 sky Gaussians"):
        merge({block: None}, block, tmp_path / "all.ply")


def test_a_truncated_block_leaves_no_merged_file(tmp_path: Path) -> None:
    first, *rest = files(tmp_path, model(50, 0))
    coarse = saved(tmp_path / "coarse.ply", model(50, 0))
    first.write_bytes(first.read_bytes()[:-10])
    with pytest.raises(InputError, match="truncated"):
        merge(dict.fromkeys([first, *rest]), coarse, tmp_path / "all.ply")
    assert not (tmp_path / "all.ply").exists()
