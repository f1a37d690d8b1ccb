"""The device of a process, and what it says where a GPU that is there is not used."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.torch_version import TorchVersion

from panolog.orchestrator.cli.commands.doctor import diagnose
from panolog.orchestrator.runs.config import RunConfig
from panolog.renderer.process import choose_device, growing_segments
from panolog.renderer.unused_gpu import unused_gpu
from panolog.scene.errors import DeviceError
from tests.nvidia_smi import print_gpus
from tests.on_device import needs_a_card

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


def test_an_old_driver_is_said_wherever_a_gpu_is_looked_for(
    old_driver: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert choose_device("auto") == choose_device(None) == "cpu"
    assert caplog.messages == [f"{OLD}; the CPU is used"] * 2
    lines: list[str] = []
    assert choose_device("auto", lines.append) == choose_device("cpu", lines.append) == "cpu"
    assert lines == [f"{OLD}; the CPU is used"]
    assert len(caplog.messages) == 2
    with pytest.raises(DeviceError) as caught:
        choose_device("cuda")
    assert str(caught.value) == f"--device cuda: {OLD}"
    (gpu,) = [finding for finding in diagnose(None, RunConfig(), None).findings if finding.what == "GPU"]
    assert (gpu.value, gpu.ok, gpu.fatal, gpu.fix) == ("none that torch can use", False, False, OLD)


TOO_OLD = "the NVIDIA driver {} is too old for torch {} with CUDA {}: update it to {} or later"
UNKNOWN = "CUDA unknown error - this may be due to an incorrectly set up environment"


@pytest.mark.parametrize(
    ("cuda", "driver", "why"),
    [
        (None, "580.65.06", f"torch {torch.__version__} is built without CUDA: install another build"),
        ("13.2", "579.9", TOO_OLD.format("579.9", torch.__version__, "13.2", 580)),
        ("12.6", "470.1", TOO_OLD.format("470.1", torch.__version__, "12.6", 525)),
        ("11.8", "390.1", TOO_OLD.format("390.1", torch.__version__, "11.8", 450)),
        ("13.0", "580.65.06", f"{UNKNOWN} (driver 580.65.06, CUDA 13.0)"),
    ],
)
def test_why_a_gpu_is_not_used(
    old_driver: Path, monkeypatch: pytest.MonkeyPatch, cuda: str | None, driver: str, why: str
) -> None:
    def init() -> None:
        raise RuntimeError(f"{UNKNOWN}\nmore")

    monkeypatch.setattr(torch.cuda, "init", init)
    monkeypatch.setattr(torch.version, "cuda", cuda)
    old_driver.write_text(f"{CARD}, {driver}\n")
    assert (unused_gpu() or "").startswith(f"{CARD} is not used: {why}")


@pytest.mark.parametrize("output", ["", "No devices were found\n"])
def test_without_a_gpu_or_with_one_that_is_hidden_nothing_is_said(
    old_driver: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, output: str
) -> None:
    for hidden in ("", "-1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
        assert unused_gpu() is None
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    old_driver.write_text(output)
    assert choose_device("auto") == "cpu"
    old_driver.with_name("nvidia-smi").unlink()
    assert choose_device("auto") == "cpu"
    assert not caplog.messages
    with pytest.raises(DeviceError, match="--device cuda: there is no GPU that torch can use"):
        choose_device("cuda")


NATIVE, GROW = "6.8.0-generic", "expandable_segments:True"


@pytest.mark.parametrize(
    ("version", "release", "given", "expected"),
    [
        ("2.13.0", NATIVE, {}, {"PYTORCH_ALLOC_CONF": GROW}),
        ("2.6.0", NATIVE, {}, {"PYTORCH_CUDA_ALLOC_CONF": GROW}),
        ("2.13.0", "5.15.90.1-microsoft-standard-WSL2", {}, {}),
        ("2.13.0", NATIVE, {"PYTORCH_ALLOC_CONF": "x"}, {}),
        ("2.13.0", NATIVE, {"PYTORCH_CUDA_ALLOC_CONF": ""}, {}),
    ],
)
def test_segments_of_a_gpu_grow_unless_the_user_has_set_something_else(
    version: str, release: str, given: dict[str, str], expected: dict[str, str]
) -> None:
    assert growing_segments(given, release, TorchVersion(version)) == expected


WORKER = """
import sys

import torch

from panolog.renderer.iteration import take
from panolog.renderer.losses import photometric_loss
from panolog.renderer.process import prepare
from panolog.renderer.render import render
from tests.renderer.hard_scenes import as_leaves, camera, cloud
from tests.renderer.test_adam import moving_of, problem_of

prepare(1)
before = torch.cuda.is_initialized()
at = camera()
model = as_leaves(cloud(20), torch.float32)
target = torch.zeros(at.height, at.width, 3, dtype=torch.uint8)
photometric_loss(render(model, at, near=0.01).color, target, None, 0.2).loss.backward()
take(problem_of(cloud(20)), moving_of(cloud(20)), 1, screen=True)
imported = [name for name in ("torch._dynamo", "torch._inductor", "sympy") if name in sys.modules]
grow = None
if torch.cuda.is_available():
    x = torch.zeros(10**7, device="cuda")
    grow = all(segment["is_expandable"] for segment in torch.cuda.memory_snapshot())
print((before, imported, grow))
"""


def worker() -> str:
    """Of a process that computes an iteration: whether CUDA is in use before it, what is imported, a card."""
    return subprocess.run([sys.executable, "-c", WORKER], check=True, capture_output=True, text=True).stdout


def test_an_iteration_needs_no_gpu_and_not_the_compiler_of_torch() -> None:
    """It took 100 MB and some seconds of each worker. Settings of a GPU come before anything is on it."""
    assert worker().startswith("(False, [], ")


@needs_a_card
def test_on_a_card_segments_grow() -> None:
    assert worker().endswith("True)\n")
