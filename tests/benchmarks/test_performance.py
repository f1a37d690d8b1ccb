"""The page of the rasterizer's benchmark, on a tiny scene."""

from pathlib import Path

import pytest

from benchmarks.performance import HEADING, ITERATION, READING, Goal, page
from benchmarks.rasterizer import rows
from benchmarks.rasterizer.cases import CaseSpec, street
from benchmarks.rasterizer.memory import Peaks
from panolog.scene.ply import write_ply
from tests.deploy.files import ROOT
from tests.scenes import write_scene


def test_the_page_has_every_part_and_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def probe(spec: CaseSpec, device: str, threads: int) -> Peaks:
        size = 300 * spec.count + 50 * spec.width**2
        return Peaks(size, size)

    monkeypatch.setattr(rows, "probe", probe)  # a process takes seconds
    model = tmp_path / "model.ply"
    write_ply(model, street(500))
    text = page(write_scene(tmp_path / "tiny"), model, "cpu", quick=True)
    for part in (HEADING, READING, ITERATION):
        assert part in text
    for goal in ("≥ 0.7", "≥ 1.8"):
        assert f"| {goal} " in text, goal
    assert "trained on tiny" in text
    kept = (ROOT / "docs/performance.md").read_text()
    assert all(part in kept for part in (HEADING, READING, ITERATION))


def test_a_goal_says_whether_it_is_met() -> None:
    assert Goal("speed-up", 1.8, 1.9).cells() == ("speed-up", "≥ 1.8", 1.9, "yes")
    assert Goal("speed-up", 1.8, 1.7).cells()[-1] == "no"
