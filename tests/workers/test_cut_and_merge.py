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
from panolog.scene.ply import COLUMNS, read_ply, write_ply
from panolog.workers.cut import retained
from panolog.workers.merge import merge

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


def files(folder: Path, gaussians: Gaussians) -> list[Path]:
    paths = [folder / f"{block}.ply" for block in range(GRID.count)]
    for block, path in enumerate(paths):
        part = retained(gaussians, cell(block), 0.0)
        write_ply(path, [part], count=len(part), sky=0)
    return paths


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
    sky = whole.select(torch.arange(300) >= 260)
    assert merge(files(tmp_path, whole), sky, tmp_path / "all.ply") == 300
    merged = read_ply(tmp_path / "all.ply")
    assert merged.sky == 40
    torch.testing.assert_close(merged.means[-40:], whole.means[-40:])
    expected = whole.means[torch.from_numpy(np.lexsort(whole.means.numpy().T))]
    torch.testing.assert_close(merged.means[torch.from_numpy(np.lexsort(merged.means.numpy().T))], expected)
    vertex = plyfile.PlyData.read(tmp_path / "all.ply")["vertex"]
    assert tuple(p.name for p in vertex.properties) == COLUMNS
    assert vertex.count == 300


def test_merge_is_the_same_to_the_byte_each_time(tmp_path: Path) -> None:
    whole = model(100, 10)
    sky = whole.select(torch.arange(100) >= 90)
    for name in ("a.ply", "b.ply"):
        merge(files(tmp_path, whole), sky, tmp_path / name)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_empty_blocks_and_no_sky_merge_to_an_empty_model(tmp_path: Path) -> None:
    nothing = model(0, 0)
    assert merge(files(tmp_path, nothing), nothing, tmp_path / "all.ply") == 0
    assert len(read_ply(tmp_path / "all.ply")) == 0


def test_a_block_with_sky_is_refused(tmp_path: Path) -> None:
    whole = model(10, 4)
    write_ply(tmp_path / "block.ply", [whole], count=10, sky=4)
    with pytest.raises(RunError, match="4 sky Gaussians"):
        merge([tmp_path / "block.ply"], whole.select(torch.arange(10) >= 6), tmp_path / "all.ply")
    with pytest.raises(ValueError, match="6 of the 10"):
        merge([], whole, tmp_path / "all.ply")


def test_a_truncated_block_leaves_no_merged_file(tmp_path: Path) -> None:
    whole = model(50, 0)
    first, *rest = files(tmp_path, whole)
    first.write_bytes(first.read_bytes()[:-10])
    with pytest.raises(InputError):
        merge([first, *rest], model(0, 0), tmp_path / "all.ply")
    assert not (tmp_path / "all.ply").exists()
