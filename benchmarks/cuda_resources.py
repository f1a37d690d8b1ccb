"""What each CUDA kernel takes of a card: registers, shared memory, spills, instructions. Needs no card.

    python -m benchmarks.cuda_resources [--arch sm_89,sm_120] [--json]

NVRTC compiles every module for every architecture, as a card's first use does. Registers, stack, spills and
shared memory are what ptxas reports (-v); instructions are the size of the machine code, with its padding;
double-precision instructions are those of the PTX, which has every one that a kernel can execute.
"""

import functools
import io
import re
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from benchmarks import report
from panolog.renderer.cuda import nvrtc

ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")  # those that are supported
_INSTRUCTION = 16  # bytes, from sm_70 on
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
    instructions: int
    doubles: int  # instructions in double precision


@dataclass(frozen=True)
class Compiled:
    """A module for one architecture."""

    log: str  # of ptxas
    code: bytes  # a cubin
    ptx: dict[str, str]  # by kernel


@functools.cache
def compiled(module: str, arch: str) -> Compiled:
    """csrc/cuda/{module}.cu. Raises DeviceError as `nvrtc.cubin`."""
    from cuda.bindings import nvrtc as library  # noqa: PLC0415  # optional, as in renderer.cuda.nvrtc

    log = io.StringIO()
    program = nvrtc.program(module, arch, ptxas_options="-v")
    code = bytes(program.compile("cubin", logs=log).code)
    text = b" " * library.nvrtcGetPTXSize(program.handle)[1]
    library.nvrtcGetPTX(program.handle, text)
    _, *bodies = re.split(r"\.entry (\w+)\(", text.decode())
    return Compiled(log.getvalue(), code, dict(zip(bodies[::2], bodies[1::2], strict=True)))


def measure(module: str, arch: str) -> list[Kernel]:
    """The kernels of csrc/cuda/{module}.cu. Raises DeviceError as `nvrtc.cubin`."""
    made = compiled(module, arch)
    _, *reports = _ENTRY.split(made.log)
    sizes = dict(_sections(made.code))
    return [
        Kernel(
            name,
            arch,
            registers=_number(r"Used (\d+) registers", found),
            shared=_number(r"(\d+) bytes smem", found, 0),
            stack=_number(r"(\d+) bytes stack frame", found),
            spills=_number(r"(\d+) bytes spill stores", found) + _number(r"(\d+) bytes spill loads", found),
            instructions=sizes[f".text.{name}"] // _INSTRUCTION,
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


def _sections(elf: bytes) -> Iterator[tuple[str, int]]:
    """Names and sizes of the sections of a 64-bit little-endian ELF file."""
    (start,) = struct.unpack_from("<Q", elf, 0x28)
    size, count, names = struct.unpack_from("<HHH", elf, 0x3A)
    headers = [struct.unpack_from("<IIQQQQ", elf, start + size * i) for i in range(count)]
    strings = headers[names][4]
    for header in headers:
        name = strings + header[0]
        yield elf[name : elf.index(b"\0", name)].decode(), header[5]


def table(kernels: Sequence[Kernel]) -> str:
    """A row for each kernel: the most over all architectures; registers and instructions for each."""
    architectures = list(dict.fromkeys(kernel.arch for kernel in kernels))
    rows = []
    for name in dict.fromkeys(kernel.name for kernel in kernels):
        own = [kernel for kernel in kernels if kernel.name == name]
        most = [
            max(getattr(kernel, field) for kernel in own)
            for field in ("shared", "stack", "spills", "doubles")
        ]
        rows.append([name, *most, *(f"{kernel.registers} / {kernel.instructions}" for kernel in own)])
    head = ("kernel", "shared B", "stack B", "spills B", "f64", *architectures)
    return report.markdown(head, rows) + "\n\nUnder each architecture: registers / instructions."


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("cuda_resources", __doc__, quick=False)
    parser.add_argument("--arch", default=",".join(ARCHITECTURES), help="separated by commas")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        found = [
            k for arch in options.arch.split(",") for module in nvrtc.MODULES for k in measure(module, arch)
        ]
        compiler = "NVRTC {}.{}".format(*nvrtc.nvrtc_version()[:2])
        content = {"compiler": compiler, "kernels": [asdict(kernel) for kernel in found]}
        return report.Report(content, f"{table(found)} {compiler}.")

    return report.run("cuda_resources", options, work)


if __name__ == "__main__":
    sys.exit(main())
