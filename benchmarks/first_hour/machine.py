"""The machine: its card, driver, compilers and versions, and what `panolog doctor` says of it."""

import platform
import shutil
import subprocess
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from benchmarks.first_hour.outcome import ROOT, Context, Outcome, python, shown
from benchmarks.first_hour.sanitizer import find_program

_PACKAGES = ("panolog", "torch", "numpy", "cuda-core", "cuda-bindings", "nvidia-cuda-nvrtc", "ray", "gsplat")
_SMI = (
    "nvidia-smi",
    "--query-gpu=name,driver_version,memory.total,power.limit,clocks.max.sm",
    "--format=csv,noheader",
)
_SECONDS = 60  # for a program that only describes the machine
_DOCTOR = python("-m", "panolog.orchestrator.cli", "doctor")


def find(context: Context) -> Outcome:
    """Everything that figures of this machine depend on. Fails where the device cannot be used."""
    facts = {name: value for name, value in _facts() if value}
    doctor = _run(_DOCTOR)
    lines = [f"- {name}: {value}" for name, value in facts.items()]
    text = "\n".join([*lines, "", "```", doctor.stdout.strip() or doctor.stderr.strip(), "```"])
    reason = ""
    if doctor.returncode:
        found = [line.split(maxsplit=1)[1] for line in doctor.stdout.splitlines() if "MISSING " in line]
        reason = f"panolog doctor: {'; '.join(found) or doctor.stderr.strip()}"
    if context.cuda and "card" not in facts:
        reason = (
            f"torch {facts.get('torch', 'is missing and')} finds no card: --device cpu rehearses without one"
        )
    commands = (shown(_SMI), shown(_DOCTOR))
    figure = facts.get("card") or facts.get("CPU", "")
    return Outcome("failed" if reason else "passed", figure, reason, commands, {"facts": facts}, text)


def _facts() -> Iterator[tuple[str, str]]:
    """Names and values; an empty value is unknown."""
    yield from _torch()
    smi = _run(_SMI)
    yield "nvidia-smi", smi.stdout.strip() if not smi.returncode else ""
    yield "nvcc", _line(_run(["nvcc", "--version"]).stdout, "release")
    yield "compute-sanitizer", str(find_program() or "")
    yield "Python", f"{platform.python_version()} on {platform.platform()}"
    for name in _PACKAGES:
        try:
            yield name, version(name)
        except PackageNotFoundError:
            yield name, ""
    yield "commit", _run(["git", "-C", str(ROOT), "describe", "--always", "--dirty"]).stdout.strip()


def _torch() -> Iterator[tuple[str, str]]:
    """What torch, the compiled module and NVRTC say."""
    import torch  # noqa: PLC0415  # slow to import, and the card may break it: only in the step's process

    from benchmarks.report import machine  # noqa: PLC0415
    from panolog.renderer.cuda import nvrtc  # noqa: PLC0415
    from panolog.scene.errors import DeviceError  # noqa: PLC0415

    found: dict[str, Any] = machine()
    yield "CPU", f"{found['cpu']}, {found['cores']} cores, {found['instruction_set']}"
    yield "torch's CUDA", torch.version.cuda or "none: a CPU build"
    try:
        major, minor, known = nvrtc.nvrtc_version()
        yield "NVRTC", f"{major}.{minor}, for {known[0]} to {known[-1]}"
    except DeviceError as error:
        yield "NVRTC", str(error)
    if not torch.cuda.is_available():
        return
    card = torch.cuda.get_device_properties(0)
    yield "card", f"{card.name}, sm_{card.major}{card.minor}"
    free, total = torch.cuda.mem_get_info()
    yield "memory of the card", f"{free / 2**30:.1f} of {total / 2**30:.1f} GiB free"
    yield "multiprocessors", str(card.multi_processor_count)


def _run(command: list[str] | tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    """The result of a program; of one that is missing or takes too long, a failure without output."""
    try:
        if shutil.which(command[0]):
            return subprocess.run(
                command, cwd=ROOT, capture_output=True, text=True, timeout=_SECONDS, check=False
            )
    except subprocess.TimeoutExpired:
        pass
    return subprocess.CompletedProcess(command, 1, "", f"{command[0]} is missing or does not answer")


def _line(text: str, word: str) -> str:
    return next((line.strip() for line in text.splitlines() if word in line), "")
