"""The page of all benchmarks, on a tiny scene."""

from pathlib import Path

import pytest

from benchmarks import memory, opensplat, rasterizer
from benchmarks.cases import Recipe
from benchmarks.memory_probe import Peaks
from benchmarks.performance import Claim, Settings, page
from benchmarks.performance_text import SECTIONS
from benchmarks.street import street
from panolog.scene.ply import write_ply
from tests.scenes import write_scene


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    def probe(recipe: Recipe, device: str, threads: int) -> Peaks:
        size = 300 * recipe.count + 50 * recipe.width**2
        return Peaks(size, size)

    monkeypatch.setattr(rasterizer, "probe", probe)  # a process takes seconds
    monkeypatch.setattr(memory, "probe", probe)
    monkeypatch.setattr(opensplat, "WIDTH", 64)
    monkeypatch.setattr("benchmarks.ceiling.SECONDS", 0.001)
    model = tmp_path / "model.ply"
    write_ply(model, [street(500)], count=500, sky=100)
    return Settings("cpu", write_scene(tmp_path / "tiny"), model, model, quick=True)


def test_the_page_has_every_section_goal_and_picture(settings: Settings, tmp_path: Path) -> None:
    text = "\n\n".join(page(settings, tmp_path / "performance.md"))
    for title, command, _ in SECTIONS.values():
        assert f"## {title}\n\n    {command}\n" in text
    for goal in ("≥ 0.7", "≥ 1.8", "≥ 0.4", "≥ 0.35", "≥ 15", "≥ 0.98", "≤ 1.3", "≤ 1.5"):
        assert f"| {goal} " in text, goal
    assert "trained on tiny" in text
    assert "(performance.svg)" in text
    assert (tmp_path / "performance.svg").read_bytes().startswith(b"<?xml")


def test_a_claim_says_whether_it_is_met() -> None:
    assert Claim("speed-up", 1.9, least=1.8).cells() == ("speed-up", "≥ 1.8", 1.9, "yes")
    assert Claim("speed-up", 1.7, least=1.8).cells()[-1] == "no"
    assert Claim("ratio", 1.4, most=1.3).cells() == ("ratio", "≤ 1.3", 1.4, "no")
    assert Claim("ratio", 1.2, most=1.3).cells()[-1] == "yes"
