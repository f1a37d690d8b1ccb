"""The rasterizer's benchmark: its rows, rates and command line."""

import json

import pytest

from benchmarks import rasterizer
from benchmarks.cases import Recipe
from benchmarks.memory_probe import Peaks
from benchmarks.rasterizer import PAIRS, TIMES, Row, benchmark, parse, recipes_of, tables


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> list[Row]:
    monkeypatch.setattr("benchmarks.ceiling.SECONDS", 0.001)
    monkeypatch.setattr(rasterizer, "probe", lambda *_: Peaks(1000, 2000))  # a process takes seconds
    return list(benchmark([Recipe(64, 200)], "cpu", [1, 2], repeats=1))


def test_one_row_for_each_number_of_threads(rows: list[Row]) -> None:
    assert [row.on for row in rows] == ["1 thread", "2 threads"]
    assert rows[0].counts == rows[1].counts
    assert rows[0].memory == 2000 + 3 * 236 * 200 + 3 * 64 * 32
    assert {len(row.time_cells(None)) for row in rows} == {len(TIMES)}
    assert {len(row.pair_cells()) for row in rows} == {len(PAIRS)}


def test_rates_and_shares_follow_from_times_counts_and_ceiling(rows: list[Row]) -> None:
    row = rows[0]
    rates, shares = row.rates(), row.shares()
    assert rates["forward_useful"] == pytest.approx(row.counts.useful / row.times.forward * 1e3)
    assert rates["backward_evaluated"] == pytest.approx(row.counts.evaluated / row.times.backward * 1e3)
    assert row.ceiling is not None
    assert shares["forward_of_ceiling"] == pytest.approx(rates["forward_useful"] / row.ceiling.forward)


def test_the_speed_up_is_beside_the_rows_on_more_threads(rows: list[Row]) -> None:
    one, two = tables(rows).splitlines()[2:4]
    gain = rows[0].times.iteration / rows[1].times.iteration
    column = TIMES.index("speed-up") + 1
    assert one.split("|")[column].strip() == "–"
    assert float(two.split("|")[column]) == pytest.approx(gain, rel=1e-2)


def test_rows_are_json(rows: list[Row]) -> None:
    content = json.loads(json.dumps(rows[0].content()))
    assert content["times"]["forward"] > 0
    assert set(content["shares"]) == {"rasterization", "forward_of_ceiling", "backward_of_ceiling"}


def test_the_command_line_asks_for_streets_a_model_or_both(capsys: pytest.CaptureFixture[str]) -> None:
    streets = list(recipes_of(parse([])))
    assert len(streets) == 9
    assert {recipe.model for recipe in streets} == {None}
    trained = ["--model", "model.ply", "--scene", "flat", "--width", "64,128"]
    assert [recipe.model for recipe in recipes_of(parse(trained))] == ["model.ply"] * 2
    both = list(recipes_of(parse([*trained, "--gaussians", "500"])))
    assert [recipe.count for recipe in both] == [500, 0, 500, 0]
    with pytest.raises(SystemExit):
        parse(["--model", "model.ply"])
    assert "go together" in capsys.readouterr().err
