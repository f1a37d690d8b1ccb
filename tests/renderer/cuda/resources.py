"""What NVRTC reports of the CUDA kernels: registers, shared memory, spills. Needs no card.

Registers, stack, spills and shared memory are what ptxas reports (-v); double-precision instructions are
those of the PTX, which has every one that a kernel can execute.
"""

import functools
import io
import re
from dataclasses import dataclass

from panolog.renderer.cuda import nvrtc

ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")  # those that are supported
_ENTRY = re.compile(r"Compiling entry function '(\w+)'")


@dataclass(frozen=True)
class Kernel:
    """One kernel for one architecture. Shared memory is of a block, the rest of a thread."""

    name: str
    arch: str
    registers: int
    shared: int  # bytes
    stack: int  # bytes
    spills: int  # bytes stored and loaded
    doubles: int  # instructions in double precision


@dataclass(frozen=True)
class Compiled:
    """A module for one architecture."""

    log: str  # of ptxas
    ptx: dict[str, str]  # by kernel


@functools.cache
def compiled(module: str, arch: str) -> Compiled:
    """csrc/cuda/{module}.cu. Raises DeviceError as `nvrtc.program`."""
    from cuda.bindings import nvrtc as library  # noqa: PLC0415  # optional, as in renderer.cuda.nvrtc

    log = io.StringIO()
    program = nvrtc.program(module, arch, ptxas_options="-v")
    program.compile("cubin", logs=log)
    text = b" " * library.nvrtcGetPTXSize(program.handle)[1]
    library.nvrtcGetPTX(program.handle, text)
    _, *bodies = re.split(r"\.entry (\w+)\(", text.decode())
    return Compiled(log.getvalue(), dict(zip(bodies[::2], bodies[1::2], strict=True)))


def measure(module: str, arch: str) -> list[Kernel]:
    """The kernels of csrc/cuda/{module}.cu. Raises DeviceError as `nvrtc.program`."""
    made = compiled(module, arch)
    _, *reports = _ENTRY.split(made.log)
    return [
        Kernel(
            name,
            arch,
            registers=_number(r"Used (\d+) registers", found),
            shared=_number(r"(\d+) bytes smem", found, 0),
            stack=_number(r"(\d+) bytes stack frame", found),
            spills=_number(r"(\d+) bytes spill stores", found) + _number(r"(\d+) bytes spill loads", found),
            doubles=len(re.findall(r"^.*\.f64\s.*;", made.ptx[name], re.MULTILINE)),
        )
        for name, found in zip(reports[::2], reports[1::2], strict=True)
    ]


def _number(pattern: str, text: str, default: int | None = None) -> int:
    """The number in ptxas's report. Raises ValueError where it is missing and has no default."""
    found = re.search(pattern, text)
    if found is None and default is None:
        raise ValueError(f"ptxas does not report {pattern!r}")
    return default or 0 if found is None else int(found[1])
