"""Leaves and levels of detail: nothing is lost, and each level shows about the same with fewer Gaussians."""

from pathlib import Path

import numpy as np
import pytest

from panolog.export.detail import Detail
from panolog.export.splats import InMemory, Splats


def wall(count: int, degree: int = 1, size: float = 0.05) -> Splats:
    """Gaussians at random places of a wall of 40 × 10 units, in two colours: red on its left, else green."""
    rng = np.random.default_rng(3)
    means = np.stack([rng.uniform(0, 40, count), rng.uniform(0, 10, count), np.zeros(count)], axis=1)
    colours = np.where(means[:, :1] < 20, [[1.0, -1, 0]], [[-1.0, 1, 0]])
    return Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.array([[1, 0, 0, 0]], np.float32), (count, 1)),
        scales=np.full((count, 3), np.log(size), np.float32),
        opacities=np.full(count, 2, np.float32),
        sh0=colours.astype(np.float32),
        shN=np.zeros((count, (0, 3, 8, 15)[degree], 3), np.float32),
    )


@pytest.mark.parametrize("degree", [0, 3])
def test_levels_have_fewer_gaussians_of_the_same_colours(tmp_path: Path, degree: int) -> None:
    detail = Detail(InMemory(wall(20_000, degree)), tmp_path, side=8, levels=4)
    leaves = list(detail.leaves())
    counts = np.sum([[len(level) for level in leaf] for leaf in leaves], axis=0)
    assert detail.sides[0] == 0
    assert detail.sides[2] == 2 * detail.sides[1]
    assert (np.diff(counts) < -0.5 * counts[:-1]).all()
    for level in range(4):
        splats = Splats.joined([leaf[level] for leaf in leaves])
        assert splats.degree == degree
        apart = np.abs(splats.means[:, 0] - 20) > detail.sides[level]
        left = splats.means[:, 0] < 20
        assert (splats.sh0[apart & left, 0] > 0.99).all()
        assert (splats.sh0[apart & ~left, 1] > 0.99).all()


def test_the_coarsest_level_is_small(tmp_path: Path) -> None:
    assert len(Detail(InMemory(wall(100_000)), tmp_path).sides) == 1
    assert len(Detail(InMemory(wall(400_000, 0)), tmp_path).sides) == 2


def test_one_place(tmp_path: Path) -> None:
    one = wall(10_000).select(np.zeros(10_000, np.int64))
    detail = Detail(InMemory(one), tmp_path, most=3000, levels=2)
    assert sum(len(leaf[0]) for leaf in detail.leaves()) == 10_000
