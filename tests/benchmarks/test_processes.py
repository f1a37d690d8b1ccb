"""Fresh processes: results and errors come back, and memory is that of the process."""

import json
import os

import pytest

from benchmarks.processes import in_fresh_process, peak_memory


def test_a_result_comes_from_another_process() -> None:
    assert in_fresh_process(os.getpid) != os.getpid()


def test_an_error_comes_back_as_it_was_raised() -> None:
    with pytest.raises(json.JSONDecodeError, match="Expecting value"):
        in_fresh_process(json.loads, "nothing")


def test_the_peak_is_at_least_what_is_held() -> None:
    held = bytes(range(256)) * 2**18  # 64 MiB, all pages written
    assert peak_memory() > len(held)
    assert peak_memory(os.getpid()) == pytest.approx(peak_memory(), rel=0.1)
