"""Lines through costs."""

import pytest

from benchmarks.fit import fit
from benchmarks.growth import Growth, Point


def test_a_plane_is_found_and_extended() -> None:
    x, y = [1e6, 2e6, 3e6, 5e6], [3.0, 1.0, 4.0, 1.0]
    plane = fit({"x": x, "y": y}, [7 + 2e-6 * a - 3 * b for a, b in zip(x, y, strict=True)])
    assert plane.constant == pytest.approx(7)
    assert plane.slopes == pytest.approx({"x": 2e-6, "y": -3})
    assert plane.r2 == pytest.approx(1)
    assert plane(x=0, y=1) == pytest.approx(4)


def test_what_is_no_line_has_a_low_r2() -> None:
    assert fit({"x": [1, 2, 3, 4]}, [1, 0, 1, 0]).r2 < 0.5


def test_costs_are_fitted_for_a_million() -> None:
    points = tuple(
        Point(1, pixels, 10, 30.0 * pixels, 5 + 2e-6 * pixels) for pixels in (1000, 500_000, 2_000_000)
    )
    more = tuple(Point(1, 1000, count, 30_000.0, 5.002 + 8e-6 * count) for count in (20, 100_000, 3_000_000))
    found = Growth(points, more)
    assert found.pixels().slopes["pixels"] == pytest.approx(2)
    assert found.gaussians().slopes["gaussians"] == pytest.approx(8)
    assert found.work().slopes == pytest.approx({"gaussians": 8, "pairs": 2 / 30}, rel=1e-3)
    assert "R²" in found.tables()
    assert set(found.content()["fits"]) == {"pixels", "gaussians", "work"}
