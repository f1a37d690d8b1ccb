"""The rasterizer's benchmark: its rows, rates, page and command line."""

from pathlib import Path

import pytest

from benchmarks.rasterizer import rows as module
from benchmarks.rasterizer.__main__ import parse, specs
from benchmarks.rasterizer.cases import CaseSpec, street
from benchmarks.rasterizer.iteration import Times
from benchmarks.rasterizer.page import TEMPLATE, goals, page
from benchmarks.rasterizer.rows import Row, benchmark
from panolog.scene.errors import InputError
from panolog.scene.ply import write_ply
from tests.deploy.files import ROOT
from tests.scenes import write_scene


def test_one_row_for_each_number_of_threads_and_the_page_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "probe", lambda *_: 2000)  # a process takes seconds
    model, scene = tmp_path / "model.ply", write_scene(tmp_path / "tiny")
    write_ply(model, street(500))
    cases = [CaseSpec(64, 200), CaseSpec(64, model=str(model), scene=str(scene))]
    rows = list(benchmark(cases, "cpu", [1, 2], repeats=1))
    assert [row.on for row in rows] == ["1 thread", "2 threads"] * 2
    assert rows[0].memory == 2000 + 3 * 236 * 200 + 3 * 64 * 32
    gain = rows[0].times.iteration / rows[1].times.iteration
    assert rows[0].speed_up is None and rows[1].speed_up == pytest.approx(gain)
    assert rows[0].content()["shares"] == {"rasterization": rows[0].times.share}
    text = page(rows)
    first, details = text.split("<details>")
    assert "trained on tiny" in first
    assert len([line for line in first.splitlines() if line.startswith("|")]) <= 10
    assert details.count("| street ") == details.count("| trained on tiny ") == 4  # in two tables
    shown = [line.split("|")[-3].strip() for line in details.splitlines() if line.startswith("| street ")]
    assert shown[0] == "–" and float(shown[1]) == pytest.approx(gain, rel=1e-2)
    kept = (ROOT / "docs/performance.md").read_text().splitlines()
    fixed = set(TEMPLATE.read_text().splitlines()) & set(text.splitlines())
    assert len(fixed) > 20 and fixed <= set(kept)


def test_a_goal_says_whether_it_is_met() -> None:
    times = Times(forward=30, loss=10, backward=60, iteration=120)
    row = Row("flat", 64, 32, 9, "cpu", 2, times, memory=1, stages=None, speed_up=1.7)
    where = "trained model at 64×32"
    assert list(goals([row])) == [
        (f"share of rasterization and Adam in an iteration, {where}", "≥ 0.7", 0.9, "yes"),
        (f"speed-up of two threads, {where}", "≥ 1.8", 1.7, "no"),
    ]


def test_the_command_line_requests_streets_a_model_or_both(capsys: pytest.CaptureFixture[str]) -> None:
    assert [spec.model for spec in specs(parse([]))] == [None] * 9
    both = ["--model", "model.ply", "--scene", "flat", "--width", "64,128", "--gaussians", "500"]
    assert [spec.count for spec in specs(parse(both))] == [500, 0, 500, 0]
    blocks = ["--block", "far,middle", "--width", "64", "--gaussians", "500", "--projection", "both"]
    assert [(spec.exact, spec.block) for spec in specs(parse(blocks))] == [
        (exact, block) for exact in (False, True) for block in ("far", "middle")
    ]
    with pytest.raises(SystemExit):
        parse(["--block", "near"])
    assert "far and middle" in capsys.readouterr().err
    with pytest.raises(InputError, match="go together"):
        list(specs(parse(both[:2])))
