"""`panolog doctor`: what this machine has, what is missing and how to mend it."""

import importlib.util
import platform
import shutil
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil
import torch

from panolog.orchestrator.resources.machine import cores, memory
from panolog.orchestrator.run.units import gib
from panolog.scene.errors import InputError

_CPUINFO = Path("/proc/cpuinfo")
_SIMD = ("avx512f", "avx2", "avx", "sse4_2", "asimd")  # best first; the kernels pick at run time


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at. A fatal one keeps the job from running."""

    what: str
    value: str
    ok: bool = True
    fatal: bool = False
    mend: str = ""  # what to do about it


def examine() -> list[Finding]:
    """What the machine has."""
    return [
        _cpu(),
        _memory(),
        _disk(Path.cwd()),
        _torch(),
        _gpu(),
        _kernels(),
        *map(_package, ("ray", "pycolmap")),
    ]


def as_json(findings: list[Finding], preflight: dict[str, Any] | None) -> dict[str, Any]:
    """What `panolog doctor --json` prints; bytes and seconds."""
    return {
        "ready": not any(finding.fatal for finding in findings),
        "findings": [asdict(f) for f in findings],
        "preflight": preflight,
    }


def _cpu() -> Finding:
    flags = set(_CPUINFO.read_text().split()) if _CPUINFO.is_file() else set()
    simd = next((name for name in _SIMD if name in flags), "none known")
    return Finding("CPU", f"{cores()} cores, {platform.machine()}, best SIMD {simd}")


def _memory() -> Finding:
    return Finding("memory", f"{gib(psutil.virtual_memory().total)}, {gib(memory())} available")


def _disk(folder: Path) -> Finding:
    return Finding("disk", f"{gib(shutil.disk_usage(folder).free)} free at {folder}")


def _torch() -> Finding:
    return Finding("torch", f"{torch.__version__}, Python {platform.python_version()}")


def _gpu() -> Finding:
    if torch.cuda.is_available():
        gpus = [torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count())]
        value = ", ".join(f"{gpu.name} ({gib(gpu.total_memory)})" for gpu in gpus)
        if not _has_core():  # a finding of its own, and without it nothing more can be asked
            return Finding("GPU", value)
        from panolog.renderer.process import choose_device  # noqa: PLC0415

        try:
            choose_device("cuda")
        except InputError as error:
            return Finding("GPU", value, ok=False, fatal=True, mend=str(error))
        return Finding("GPU", value)
    mend = "the CPU does the work" if shutil.which("nvidia-smi") is None else "install a CUDA build of torch"
    return Finding("GPU", "none that torch can use", ok=False, mend=mend)


def _has_core() -> bool:
    return importlib.util.find_spec("panolog.renderer._core") is not None


def _kernels() -> Finding:
    if _has_core():
        return Finding("compiled core", "present")
    mend = "install PanoLOG again: `make setup`, or pip install ."
    return Finding("compiled core", "missing", ok=False, fatal=True, mend=mend)


def _package(name: str) -> Finding:
    try:
        return Finding(name, version(name))
    except PackageNotFoundError:
        return Finding(name, "missing", ok=False, fatal=True, mend=f"pip install {name}")
