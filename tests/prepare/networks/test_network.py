"""Where a network runs, and what is said of files that are none. Nothing here needs a GPU."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import onnxruntime
import pytest

from panolog.prepare.networks.manifest import DepthManifest, read_manifest
from panolog.prepare.networks.network import Network, providers
from panolog.scene.errors import InputError, PanologError
from tests.prepare.networks.networks import given, red_depth

CPU, CUDA, TENSORRT = (f"{name}ExecutionProvider" for name in ("CPU", "CUDA", "Tensorrt"))
MANIFEST = {
    "task": "depth",
    "input": given(16),
    "depth": {"output": "depth", "kind": "depth", "distance": "radial"},
}


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return red_depth(tmp_path, MANIFEST)


def opened(model: Path, device: str = "auto") -> Network:
    return Network(model, read_manifest(model.with_suffix(".yaml"), DepthManifest).input, ["depth"], device)


@pytest.mark.parametrize(
    "device, available, tensorrt, wanted",
    [
        ("auto", [CPU], False, [CPU]),
        ("auto", ["AzureExecutionProvider", CPU], True, [CPU]),
        ("auto", [TENSORRT, CUDA, CPU], False, [CUDA, CPU]),  # its builds for GPUs always name TensorRT
        ("auto", [TENSORRT, CUDA, CPU], True, [TENSORRT, CUDA, CPU]),
        ("cuda", [TENSORRT, CUDA, CPU], True, [CUDA, CPU]),
        ("tensorrt", [TENSORRT, CUDA, CPU], False, [TENSORRT, CUDA, CPU]),
        ("cpu", [TENSORRT, CUDA, CPU], True, [CPU]),
    ],
)
def test_providers(device: str, available: Sequence[str], tensorrt: bool, wanted: list[str]) -> None:
    assert providers(device, available, tensorrt=tensorrt) == wanted


def test_devices_that_are_not_there_are_refused() -> None:
    with pytest.raises(InputError, match="--device gpu: choose auto, cpu, cuda, tensorrt"):
        providers("gpu", [CPU], tensorrt=False)
    with pytest.raises(InputError, match="--device cuda: this onnxruntime cannot"):
        providers("cuda", [CPU], tensorrt=False)


def test_a_gpu_that_does_not_start_is_no_silent_cpu(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a build for GPUs where CUDA is broken, a session goes to the CPU without a word."""
    session = Mock(**{"get_providers.return_value": [CPU]})
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr("onnxruntime.InferenceSession", lambda *_, **__: session)
    monkeypatch.setattr("onnxruntime.preload_dlls", lambda: None)
    with pytest.raises(InputError, match="--device cuda: onnxruntime could not start it"):
        opened(model, "cuda")


def test_where_the_gpu_fails_the_cpu_works(
    model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = onnxruntime.InferenceSession

    def session(path: str, options: Any, *, providers: list[str], **rest: Any) -> Any:
        if CUDA in providers:
            raise RuntimeError("CUDA error 999")
        return real(path, options, providers=providers, **rest)

    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: [CUDA, CPU])
    monkeypatch.setattr("onnxruntime.InferenceSession", session)
    monkeypatch.setattr("onnxruntime.preload_dlls", lambda: print("Failed to load libcublas"))
    assert opened(model).device == "cpu"
    assert capsys.readouterr().out == ""  # stdout is for results
    with pytest.raises(InputError, match="cannot open it with CUDAExecutionProvider: CUDA error 999"):
        opened(model, "cuda")


def test_without_onnxruntime_it_says_what_to_install(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match="pip install onnxruntime"):
        opened(model)


def test_mutated_networks_are_refused_or_run(model: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data, messages, random = model.read_bytes(), set[str](), np.random.default_rng(0)
    put = read_manifest(model.with_suffix(".yaml"), DepthManifest).input
    for turn in range(100):
        changed = bytearray(data)
        for at in random.integers(0, len(data), 1 + turn % 4):
            changed[at] = random.integers(256)
        model.write_bytes(changed if turn % 3 else changed[: random.integers(len(data))])
        try:
            Network(model, put, ["depth"], "cpu").run(np.zeros((2, 16, 32, 3), np.uint8))
        except PanologError as error:
            assert "net.onnx" in str(error) and "\n" not in str(error)
            messages.add(str(error))
    assert len(messages) > 10
    assert capfd.readouterr().err == ""  # onnxruntime's own lines would repeat ours
