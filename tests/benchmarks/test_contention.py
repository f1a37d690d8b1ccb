"""The benchmark of other busy processes, small; and the table that it makes."""

import json

import pytest

from benchmarks.contention import Phase, main, rows


def test_the_table_has_medians_spread_and_ratios() -> None:
    phases = [Phase(0, 2, (9.0, 10.0, 12.0)), Phase(1, 2, (5.0, 7.0, 4.0))]
    assert rows(phases) == [(0, 2, 10.0, 9.0, 12.0, 1.0), (1, 2, 5.0, 4.0, 7.0, 0.5)]


@pytest.mark.system
def test_the_whole_measurement_small(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.contention._SETTLE_S", 0.0)  # what is measured does not matter
    assert main(["--quick", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [phase["taken"] for phase in found["phases"]][:2] == [0, 1]
    assert all(rate > 0 for phase in found["phases"] for rate in phase["rates"])
