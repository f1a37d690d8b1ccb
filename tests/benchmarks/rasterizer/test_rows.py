"""The rasterizer's benchmark: its rows, rates and command line."""

import json

import pytest

from benchmarks.rasterizer import rows as module
from benchmarks.rasterizer.__main__ import parse, specs
from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.rows import TIMES, Row, benchmark, tables


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> list[Row]:
    monkeypatch.setattr(module, "probe", lambda *_: 2000)  # a process takes seconds
    return list(benchmark([CaseSpec(64, 200)], "cpu", [1, 2], repeats=1))


def test_one_row_for_each_number_of_threads(rows: list[Row]) -> None:
    assert [row.on for row in rows] == ["1 thread", "2 threads"]
    assert rows[0].memory == 2000 + 3 * 236 * 200 + 3 * 64 * 32
    assert rows[1].speed_up == pytest.approx(rows[0].times.iteration / rows[1].times.iteration)


def test_the_speed_up_is_in_the_rows_on_more_threads(rows: list[Row]) -> None:
    one, two = tables(rows).splitlines()[2:4]
    gain = rows[0].times.iteration / rows[1].times.iteration
    column = [name for name, _ in TIMES].index("speed-up") + 1
    assert one.split("|")[column].strip() == "–"
    assert float(two.split("|")[column]) == pytest.approx(gain, rel=1e-2)


def test_rows_are_json(rows: list[Row]) -> None:
    content = json.loads(json.dumps(rows[0].content()))
    assert content["times"]["forward"] > 0
    assert content["shares"] == {"rasterization": rows[0].times.share}


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
