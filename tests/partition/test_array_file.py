"""Arrays in a file without a name."""

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.partition.array_file import ArrayFile


def test_rows_are_read_as_they_were_written_in_any_order(tmp_path: Path) -> None:
    file, values = ArrayFile(tmp_path), np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    first, second = file.reserve(values.shape, np.float32), file.reserve((5,), np.int64)
    for start in (60, 0, 30):
        file.write(first, start, values[start : start + 40])
    assert np.array_equal(file.read(first), values)
    assert np.array_equal(file.rows(first, 33, 80), values[33:80])
    assert np.array_equal(file.read(second), np.zeros(5))  # not written
    file.write(second, 2, np.array([7, 8]))
    assert file.read(second).tolist() == [0, 0, 7, 8, 0]
    assert not list(tmp_path.iterdir())


def test_a_value_keeps_all_that_it_has(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    values: list[dict[str, Any]] = [
        {"name": n, "array": random.integers(0, 9, (n, 2)), "none": np.zeros((0, 3))} for n in range(4)
    ]
    file = ArrayFile(tmp_path)
    kept = [file.keep(value) for value in values]
    before = file.load(kept[0])
    file.keep(np.ones(100_000))  # the file grows
    for value, found in zip(values, map(file.load, kept), strict=True):
        assert found["name"] == value["name"]
        assert np.array_equal(found["array"], value["array"]) and found["none"].shape == (0, 3)
        assert not found["array"].flags.writeable or not found["array"].size
    del file
    assert np.array_equal(before["array"], values[0]["array"])


def test_a_full_disk_is_an_error_and_no_signal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = lambda **_: Path("/dev/full").open("wb", buffering=0)  # noqa: E731, SIM115
    monkeypatch.setattr("panolog.partition.array_file.tempfile.TemporaryFile", full)
    with pytest.raises(OSError, match="No space left") as error:
        ArrayFile(tmp_path).keep(np.ones(1000))
    assert error.value.errno == errno.ENOSPC
