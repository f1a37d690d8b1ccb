"""The colours of blocks: apart from each other for all eyes, and visible on light and dark."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.orchestrator.watch.views.palette import BLOCK_COLORS, block_color

# Linear RGB as seen with no red and with no green cones: Machado, Oliveira and Fernandes 2009, severity 1.
EYES = {
    "all cones": np.eye(3),
    "no red": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "no green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
XYZ = np.array([[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07217], [0.01933, 0.11919, 0.95030]])


def linear(color: str) -> NDArray[np.float64]:
    parts = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)


def lab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIELAB, D65."""
    x, y, z = np.cbrt(np.maximum(np.clip(rgb, 0, 1) @ XYZ.T / [0.95047, 1, 1.08883], 1e-6))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def luminance(color: str) -> float:
    return float(linear(color) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("across", range(1, 7))
def test_neighbours_in_a_grid_have_different_colours(across: int) -> None:
    colors = [block_color(block) for block in range(100)]
    assert all(a != b for a, b in pairwise(colors))
    assert all(a != b for a, b in zip(colors, colors[across:], strict=False))


def test_block_colours_stand_out_from_light_and_dark() -> None:
    for color in BLOCK_COLORS:
        assert 1.05 / (luminance(color) + 0.05) > 3
        assert (luminance(color) + 0.05) / (luminance("#151a21") + 0.05) > 3


@pytest.mark.parametrize("eyes", EYES)
def test_blocks_can_be_told_apart(eyes: str) -> None:
    seen = [lab(EYES[eyes] @ linear(color)) for color in BLOCK_COLORS]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 19
