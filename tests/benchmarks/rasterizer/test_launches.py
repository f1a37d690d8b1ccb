"""The benchmark of the host's time: it launches what a training iteration launches, each kernel once."""

import json

import pytest

pytest.importorskip("cuda.core", reason="needs cuda-core: pip install cuda-core")

from benchmarks.rasterizer.launches import main


def test_each_kernel_is_launched_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--quick", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["launches"] == dict.fromkeys(
        [
            "project_forward",
            "bin_narrow",
            "composite_forward",
            "loss_similarity",
            "loss_gradient",
            "loss_absolute",
            "composite_backward",
            "project_backward",
            "iteration_guard",
            "adam_step",
            "iteration_statistics",
        ],
        1,
    )
    assert 0 < found["fastest_ms"] <= found["median_ms"]
