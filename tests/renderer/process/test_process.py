"""The device of a process, and what it says where a GPU that is there is not used."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from panolog.orchestrator.commands.doctor import diagnose
from panolog.orchestrator.run.config import RunConfig
from panolog.renderer import process
from panolog.renderer.process import choose_device
from panolog.renderer.unused_gpu import unused_gpu
from panolog.scene.errors import DeviceError
from tests.nvidia_smi import print_gpus

CARD = "NVIDIA GeForce RTX 4090"


@pytest.fixture
def old_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What nvidia-smi prints; torch is a build for CUDA 13.0 and finds no GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    return print_gpus(tmp_path, monkeypatch, f"{CARD}, 535.104.05\n{CARD}, 535.104.05\n")


OLD = (
    f"{CARD} is not used: the NVIDIA driver 535.104.05 is too old for torch {torch.__version__} with"
    " CUDA 13.0: update it to 580 or later, or install a torch with an earlier CUDA"
)


def test_an_old_driver_is_said_where_the_cpu_is_used_instead(
    old_driver: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert choose_device("auto") == choose_device(None) == "cpu"
    assert caplog.messages == [f"{OLD}; the CPU is used"] * 2
    lines: list[str] = []
    assert choose_device("auto", lines.append) == "cpu"
    assert lines == [f"{OLD}; the CPU is used"]
    caplog.clear()
    assert choose_device("cpu") == "cpu"
    assert not caplog.messages


def test_an_old_driver_is_why_cuda_is_refused(old_driver: Path) -> None:
    with pytest.raises(DeviceError) as caught:
        choose_device("cuda")
    assert str(caught.value) == f"--device cuda: {OLD}"


def test_the_doctor_says_it_too(old_driver: Path) -> None:
    (gpu,) = [finding for finding in diagnose(None, RunConfig(), None).findings if finding.what == "GPU"]
    assert (gpu.value, gpu.ok, gpu.fatal, gpu.fix) == ("none that torch can use", False, False, OLD)


def test_a_torch_without_cuda(old_driver: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    assert unused_gpu() == (
        f"{CARD} is not used: torch {torch.__version__} is built without CUDA: install another build, see"
        " https://pytorch.org"
    )


@pytest.mark.parametrize(
    ("version", "cuda", "needed"), [("579.9", "13.2", 580), ("470.1", "12.6", 525), ("390.1", "11.8", 450)]
)
def test_the_driver_that_each_cuda_needs(
    old_driver: Path, monkeypatch: pytest.MonkeyPatch, version: str, cuda: str, needed: int
) -> None:
    monkeypatch.setattr(torch.version, "cuda", cuda)
    old_driver.write_text(f"{CARD}, {version}\n")
    assert f"with CUDA {cuda}: update it to {needed} or later" in (unused_gpu() or "")


def test_where_the_driver_is_new_enough_torch_says_why(
    old_driver: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def init() -> None:
        raise RuntimeError("CUDA unknown error - this may be due to an incorrectly set up environment\nmore")

    monkeypatch.setattr(torch.cuda, "init", init)
    old_driver.write_text(f"{CARD}, 580.65.06\n")
    assert unused_gpu() == (
        f"{CARD} is not used: CUDA unknown error - this may be due to an incorrectly set up environment"
        " (driver 580.65.06, CUDA 13.0)"
    )


@pytest.mark.parametrize("output", ["", "No devices were found\n"])
def test_without_a_gpu_nothing_is_said(
    old_driver: Path, caplog: pytest.LogCaptureFixture, output: str
) -> None:
    old_driver.write_text(output)
    assert choose_device("auto") == "cpu"
    old_driver.with_name("nvidia-smi").unlink()
    assert choose_device("auto") == "cpu"
    assert not caplog.messages
    with pytest.raises(DeviceError, match="--device cuda: there is no GPU that torch can use"):
        choose_device("cuda")


@pytest.mark.parametrize("hidden", ["", "-1"])
def test_a_gpu_that_is_hidden_is_not_missed(
    old_driver: Path, monkeypatch: pytest.MonkeyPatch, hidden: str
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
    assert unused_gpu() is None


NATIVE, GROW = "6.8.0-generic", "expandable_segments:True"


@pytest.mark.parametrize(
    ("version", "release", "given", "expected"),
    [
        ("2.13.0", NATIVE, {}, {"PYTORCH_ALLOC_CONF": GROW}),
        ("2.6.0", NATIVE, {}, {"PYTORCH_CUDA_ALLOC_CONF": GROW}),
        ("2.13.0", "5.15.90.1-microsoft-standard-WSL2", {}, {}),
        ("2.13.0", NATIVE, {"PYTORCH_ALLOC_CONF": "x"}, {"PYTORCH_ALLOC_CONF": "x"}),
        ("2.13.0", NATIVE, {"PYTORCH_CUDA_ALLOC_CONF": ""}, {"PYTORCH_CUDA_ALLOC_CONF": ""}),
    ],
)
def test_segments_of_a_gpu_grow_unless_the_user_has_set_something_else(
    monkeypatch: pytest.MonkeyPatch,
    version: str,
    release: str,
    given: dict[str, str],
    expected: dict[str, str],
) -> None:
    environment = dict(given)
    monkeypatch.setattr("os.environ", environment)
    monkeypatch.setattr("platform.release", lambda: release)
    monkeypatch.setattr(torch, "__version__", torch.torch_version.TorchVersion(version))
    process._use_expandable_segments()
    assert environment == expected


PROBE = """
import torch
from panolog.renderer.process import prepare
prepare(1)
print(torch.cuda.is_initialized(), end=" ")
if torch.cuda.is_available():
    x = torch.zeros(10**7, device="cuda")
    print(all(segment["is_expandable"] for segment in torch.cuda.memory_snapshot()))
"""


def probe() -> list[str]:
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_worker_has_set_it_before_anything_is_on_a_gpu() -> None:
    assert probe()[0] == "False"


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA card")
def test_on_a_card_segments_grow() -> None:
    assert probe()[1] == "True"


STEP = """
import sys

import torch

from panolog.renderer.adam import adam_
from panolog.renderer.losses import photometric_loss
from panolog.renderer.render import render
from tests.renderer.hard_scenes import as_leaves, camera, cloud

at = camera()
model = as_leaves(cloud(20), torch.float32)
target = torch.zeros(at.height, at.width, 3, dtype=torch.uint8)
photometric_loss(render(model, at, near=0.01).color, target, None, 0.2).loss.backward()
moments = torch.zeros_like(model.means), torch.zeros_like(model.means)
adam_(model.means.detach(), model.means.grad, *moments, lr=0.1, step=1, rows=20)
print([name for name in ("torch._dynamo", "torch._inductor", "sympy") if name in sys.modules])
"""


def test_an_iteration_does_not_import_the_compiler_of_torch() -> None:
    """It took 100 MB and some seconds of each worker."""
    found = subprocess.run([sys.executable, "-c", STEP], check=True, capture_output=True, text=True)
    assert found.stdout == "[]\n"
