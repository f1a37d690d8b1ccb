"""The page of the rasterizer's benchmark, on a tiny scene."""

from pathlib import Path

import pytest

from benchmarks.performance import HEADING, ITERATION, LONG, READING, SUMMARY, goals, measure, page
from benchmarks.rasterizer import rows
from benchmarks.rasterizer.cases import street
from benchmarks.rasterizer.iteration import Times
from panolog.scene.ply import write_ply
from tests.deploy.files import ROOT
from tests.scenes import write_scene


def test_the_page_has_every_part_and_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "probe", lambda *_: 2000)  # a process takes seconds
    model = tmp_path / "model.ply"
    write_ply(model, street(500))
    text = page(list(measure(write_scene(tmp_path / "tiny"), model, "cpu", quick=True)))
    for part in (HEADING, SUMMARY, READING, ITERATION, LONG):
        assert part in text
    for goal in ("≥ 0.7", "≥ 1.8"):
        assert f"| {goal} " in text, goal
    first, details = text.split("<details>")
    assert "trained on tiny" in first
    assert len([line for line in first.splitlines() if line.startswith("|")]) <= 10
    assert details.count("| street ") == details.count("| trained on tiny ") > 1
    kept = (ROOT / "docs/performance.md").read_text()
    assert all(part in kept for part in (HEADING, SUMMARY, READING, ITERATION, LONG))


def test_a_goal_says_whether_it_is_met() -> None:
    times = Times(forward=30, loss=10, backward=50, adam=10, iteration=120)
    row = rows.Row("flat", 64, 32, 9, "cpu", 2, times, memory=1, stages=None, speed_up=1.7)
    where = "trained model at 64×32"
    assert list(goals([row])) == [
        (f"share of rasterization in an iteration, {where}", "≥ 0.7", 0.8, "yes"),
        (f"speed-up of two threads, {where}", "≥ 1.8", 1.7, "no"),
    ]
