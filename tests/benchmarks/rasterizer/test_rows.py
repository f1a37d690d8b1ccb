"""The rasterizer's benchmark: its rows, rates and command line."""

import json

import pytest

from benchmarks.rasterizer import rows as module
from benchmarks.rasterizer.__main__ import parse, specs
from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.rows import TIMES, benchmark, tables


def test_one_row_for_each_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "probe", lambda *_: 2000)  # a process takes seconds
    rows = list(benchmark([CaseSpec(64, 200)], "cpu", [1, 2], repeats=1))
    assert [row.on for row in rows] == ["1 thread", "2 threads"]
    assert rows[0].memory == 2000 + 3 * 236 * 200 + 3 * 64 * 32
    gain = rows[0].times.iteration / rows[1].times.iteration
    assert rows[1].speed_up == pytest.approx(gain)
    one, two = tables(rows).splitlines()[2:4]
    column = [name for name, _ in TIMES].index("speed-up") + 1
    assert one.split("|")[column].strip() == "–"
    assert float(two.split("|")[column]) == pytest.approx(gain, rel=1e-2)
    assert json.loads(json.dumps(rows[0].content()))["shares"] == {"rasterization": rows[0].times.share}


def test_the_command_line_requests_streets_a_model_or_both(capsys: pytest.CaptureFixture[str]) -> None:
    streets = list(specs(parse([])))
    assert len(streets) == 9
    assert {spec.model for spec in streets} == {None}
    trained = ["--model", "model.ply", "--scene", "flat", "--width", "64,128"]
    assert [spec.model for spec in specs(parse(trained))] == ["model.ply"] * 2
    both = list(specs(parse([*trained, "--gaussians", "500"])))
    assert [spec.count for spec in both] == [500, 0, 500, 0]
    blocks = ["--block", "far,middle", "--width", "64", "--gaussians", "500", "--projection", "both"]
    assert [(spec.exact, spec.block) for spec in specs(parse(blocks))] == [
        (exact, block) for exact in (False, True) for block in ("far", "middle")
    ]
    with pytest.raises(SystemExit):
        parse(["--block", "near"])
    assert "far and middle" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        parse(["--model", "model.ply"])
    assert "go together" in capsys.readouterr().err
