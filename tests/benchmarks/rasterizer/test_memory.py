"""Peak memory, measured in a fresh process."""

import pytest

from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.memory import probe
from benchmarks.rasterizer.rows import PARAMETERS


@pytest.mark.system
def test_a_peak_holds_at_least_the_gradients_and_the_image() -> None:
    found = probe(CaseSpec(128, 20_000), "cpu", 1)
    least = 20_000 * PARAMETERS + 128 * 64 * 20
    assert least < found < 8 * least
