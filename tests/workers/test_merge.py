"""Cut and merge together: every Gaussian of the model is in the result once, sky last."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cell, Grid
from panolog.scene.errors import InputError, RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import COLUMNS, read_ply, write_ply, write_ply_parts
from panolog.workers.merge import merge, retained

BOX = Aabb(np.full(3, -1.0), np.full(3, 1.0))
GRID = Grid((2, 1, 2))


def model(count: int, sky: int, spread: float = 3.0) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=spread * normal(count, 3),
        quats=normal(count, 4),
        scales=normal(count, 3),
        opacities=normal(count),
        sh0=normal(count, 1, 3),
        shN=normal(count, 15, 3),
        sky=sky,
    )


def cell(block: int) -> Cell:
    return Cell(BOX, GRID, block)


def saved(path: Path, gaussians: Gaussians) -> Path:
    write_ply(path, gaussians)
    return path


def files(folder: Path, gaussians: Gaussians) -> list[Path]:
    return [
        saved(folder / f"{block}.ply", retained(gaussians, cell(block), 0.0)) for block in range(GRID.count)
    ]


def test_blocks_partition_the_scene_without_sky() -> None:
    whole = model(300, 40)
    parts = [retained(whole, cell(block), 0.0) for block in range(GRID.count)]
    assert sum(map(len, parts)) == 260
    assert all(part.sky == 0 for part in parts)
    together = np.concatenate([part.means.numpy() for part in parts])
    assert len(np.unique(together, axis=0)) == 260


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
    whole = model(300, 40)
    coarse = saved(tmp_path / "coarse.ply", whole)
    assert merge(files(tmp_path, whole), coarse, tmp_path / "all.ply") == 300
    merged = read_ply(tmp_path / "all.ply")
    assert merged.sky == 40
    parts = [retained(whole, cell(block), 0.0) for block in range(GRID.count)]
    parts.append(whole.select(torch.arange(300) >= 260))
    write_ply_parts(tmp_path / "expected.ply", parts, count=300, sky=40)
    assert (tmp_path / "all.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()
    vertex = plyfile.PlyData.read(tmp_path / "all.ply")["vertex"]
    assert tuple(p.name for p in vertex.properties) == COLUMNS
    assert vertex.count == 300


def test_the_merged_model_is_seen_as_that_of_stage_1(tmp_path: Path) -> None:
    whole = replace(model(50, 5), exact=True)
    merge(files(tmp_path, whole), saved(tmp_path / "coarse.ply", whole), tmp_path / "all.ply")
    assert read_ply(tmp_path / "all.ply").exact


def test_empty_blocks_and_no_sky_merge_to_an_empty_model(tmp_path: Path) -> None:
    nothing = model(0, 0)
    assert merge(files(tmp_path, nothing), saved(tmp_path / "coarse.ply", nothing), tmp_path / "all.ply") == 0
    assert len(read_ply(tmp_path / "all.ply")) == 0


def test_a_block_with_sky_is_refused(tmp_path: Path) -> None:
    block = saved(tmp_path / "block.ply", model(10, 4))
    with pytest.raises(RunError, match="4 sky Gaussians"):
        merge([block], block, tmp_path / "all.ply")


def test_a_truncated_block_leaves_no_merged_file(tmp_path: Path) -> None:
    first, *rest = files(tmp_path, model(50, 0))
    coarse = saved(tmp_path / "coarse.ply", model(50, 0))
    first.write_bytes(first.read_bytes()[:-10])
    with pytest.raises(InputError, match="truncated"):
        merge([first, *rest], coarse, tmp_path / "all.ply")
    assert not (tmp_path / "all.ply").exists()


def test_a_block_of_another_program_is_refused(tmp_path: Path) -> None:
    coarse = saved(tmp_path / "coarse.ply", model(5, 0))
    renamed = tmp_path / "block.ply"
    renamed.write_bytes(coarse.read_bytes().replace(b"float nx", b"float qx"))
    with pytest.raises(InputError, match="other columns"):
        merge([renamed], coarse, tmp_path / "all.ply")
