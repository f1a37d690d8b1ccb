"""Peak memory, measured in a fresh process."""

import pytest

from benchmarks.rasterizer.cases import Recipe
from benchmarks.rasterizer.memory import probe
from benchmarks.rasterizer.rows import PARAMETERS
from panolog.scene.errors import InputError


def test_a_peak_holds_at_least_the_gradients_and_the_image() -> None:
    found = probe(Recipe(128, 20_000), "cpu", 1)
    least = 20_000 * PARAMETERS + 128 * 64 * 20
    assert least < found.rasterization < 8 * least
    assert found.iteration >= 0.9 * found.rasterization


def test_a_probe_that_fails_says_why() -> None:
    with pytest.raises(InputError, match=r"nowhere"):
        probe(Recipe(64, model="nowhere.ply", scene="nowhere"), "cpu", 1)
