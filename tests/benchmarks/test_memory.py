"""Peak memory: measured in a process of its own, and counted for gsplat."""

import pytest

from benchmarks.cases import Recipe
from benchmarks.memory import GOAL, PARAMETERS, Row, gsplat_bytes, laws, probe, tables
from benchmarks.pairs import Counts
from panolog.scene.errors import RunError


def test_a_peak_holds_at_least_the_gradients_and_the_image() -> None:
    found = probe(Recipe(128, 20_000), "cpu", 1)
    least = 20_000 * PARAMETERS + 128 * 64 * 20
    assert least < found.rasterization < 8 * least
    assert found.iteration >= 0.9 * found.rasterization


def test_a_probe_that_fails_says_why() -> None:
    with pytest.raises(RunError, match=r"nowhere"):
        probe(Recipe(64, model="nowhere.ply", scene="nowhere"), "cpu", 1)


def test_gsplat_holds_coefficients_and_their_gradients_of_what_is_visible() -> None:
    one = gsplat_bytes(0, 1e6, 0, 16, 16) - gsplat_bytes(0, 0, 0, 16, 16)
    assert 2 * 192e6 < one < 4 * 192e6
    assert gsplat_bytes(0, 0, 1e6, 16, 16) == pytest.approx(24e6, rel=1e-2)  # the sort
    assert gsplat_bytes(0, 0, 0, 1600, 1600) == pytest.approx(44 * 1600 * 1600 + 4 * 100 * 100)


def test_the_rows_bytes_are_divided_among_gaussians_pixels_and_entries() -> None:
    def row(width: int, gaussians: int, entries: int) -> Row:
        peak = 320 * gaussians + 50 * width * width // 2 + 44 * entries
        gsplat = gsplat_bytes(gaussians, gaussians, entries, width, width // 2)
        return Row(width, width // 2, gaussians, Counts(1, 1, entries, gaussians), peak, gsplat)

    rows = [
        row(256, 1000, 5000),
        row(256, 8000, 9000),
        row(512, 1000, 15000),
        row(512, 8000, 50000),
        row(1024, 9, 99),
    ]
    law = laws(rows)
    assert law.slopes == pytest.approx({"Gaussian": 320, "pixel": 50, "entry": 44})
    assert law.r2 == pytest.approx(1)
    assert f"goal: {GOAL}" in tables(rows)
