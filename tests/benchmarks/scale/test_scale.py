"""The page of scale, and the laws on small cities."""

import re
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from benchmarks.scale.laws import laws, pictures, shown
from benchmarks.scale.merging import exponent
from benchmarks.scale.page import TEMPLATE, page
from benchmarks.scale.places import city
from panolog.orchestrator.engine.estimates.calibration import Basis
from tests.deploy.files import ROOT
from tests.orchestrator.calibrated import calibrated

pytestmark = pytest.mark.system

BASES = {64: Basis(calibrated(), 3.0)}


def test_a_city_is_denser_in_points_near_its_panoramas() -> None:
    scene = city(40, 64)
    assert (len(scene.panoramas), len(scene.test), len(scene.points)) == (40, 5, 40 * 250)
    distance = np.linalg.norm((scene.points - np.repeat(scene.centers, 250, axis=0))[:, :2], axis=1)
    assert distance.min() >= 6
    assert np.median(distance) == pytest.approx(np.sqrt(6 * 60), rel=0.1)


def test_blocks_need_more_of_wider_panoramas_and_stage_one_of_larger_cities() -> None:
    found = list(laws(BASES, [75, 300], [64, 128]))
    assert [(row.panoramas, row.width) for row in found] == [(75, 64), (75, 128), (300, 64), (300, 128)]
    narrow, wide, large, _ = found
    assert wide.block > narrow.block and wide.block_gpu > narrow.block_gpu
    assert wide.block_seconds > narrow.block_seconds > 0
    assert large.coarse > narrow.coarse and large.gaussians > 3 * narrow.gaussians
    assert large.score_seconds > 0
    drawn = pictures(found)
    assert all(f"/{name}.svg)" in TEMPLATE.read_text() for name in drawn)
    assert all(f"{width}×{width // 2}" in svg for svg in drawn.values() for width in (64, 128))


def test_the_page_has_what_was_found_and_marks_what_was_not_measured() -> None:
    merge = [
        {"blocks": n, "gaussians": n * 1000, "seconds": 2.0 * n, "speed": 100.0, "cat": 200.0, "memory": 1.0}
        for n in (10, 40)
    ]
    found: dict[str, Any] = {
        "laws": [asdict(row) for row in laws(BASES, [75], [64])],
        "calibrations": [asdict(row) for row in shown(BASES)],
        "merge": merge,
    }
    written = page(found, "a machine", "scale")
    headings = [line for line in written.splitlines() if line.startswith("## ")]
    assert headings == ["## The tasks of a city", "## Merge"]
    assert "](scale/block-memory.svg)" in written
    assert re.search(r"\| 1,000,000,000\* +\| 1,000,000 +\| 2,000,000 +\| – ", written)
    assert "power 1.00" in written


def test_the_page_in_the_documentation_has_the_text_of_the_template() -> None:
    kept = (ROOT / "docs/scale.md").read_text().splitlines()
    lines = [line for line in TEMPLATE.read_text().splitlines() if "{" not in line]
    assert len(lines) > 50
    assert [line for line in lines if line not in kept] == []


def test_the_law_of_powers() -> None:
    factor, power = exponent([1.0, 10.0, 100.0], [3.0, 30 * 10**0.5, 3000.0])
    assert factor == pytest.approx(3.0)
    assert power == pytest.approx(1.5)
