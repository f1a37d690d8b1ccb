import json

import pytest

from benchmarks.rasterizer import pairs


def test_no_more_pairs_than_the_estimate_assumes(capsys: pytest.CaptureFixture[str]) -> None:
    pairs.main(["--random", "2000,20000", "--width", "256,512", "--json"])
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 4
    assert all(1 < row["pairs"] < row["assumed"] for row in rows)
