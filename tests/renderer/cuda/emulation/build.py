"""Kernels as libraries of the host: compiled by its C++ compiler with every access checked."""

import ctypes
import fcntl
import functools
import hashlib
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from panolog.renderer.cuda.nvrtc import CSRC

HERE = Path(__file__).parent
BUILD = Path(__file__).parents[4] / "build" / "emulation"
COMMON = (
    *("-std=c++17", "-fPIC", "-fno-exceptions", "-U_FORTIFY_SOURCE", "-Wall"),
    *("-g1", "-gdwarf-4"),  # of DWARF 5 some addr2line name another file
)
RUNTIME = (*COMMON, "-O2", "-Wno-clobbered", "-Werror")
KERNELS = (
    *COMMON,
    "-fno-threadsafe-statics",
    "-fno-strict-aliasing",  # float4 is the memory of other structs
    "-ftrivial-auto-var-init=pattern",
    "-Wno-unused-function",
    "-Wno-unknown-pragmas",
)
INSTRUMENTED = ("-O1", "-fsanitize=thread", "-fsanitize=bounds,alignment")
CONTRACTED = ("-ffp-contract=fast", "-fexpensive-optimizations", "-mfma")
GUARD = 4096  # bytes after each shared variable


def included(source: Path, folders: tuple[Path, ...]) -> list[Path]:
    """A file and every header that it includes by name in quotes, from its own folder or one of `folders`."""
    found: list[Path] = []
    waiting = [source]
    while waiting:
        file = waiting.pop()
        if file in found:
            continue
        found.append(file)
        for name in re.findall(r'^\s*#\s*include\s+"([^"]+)"', file.read_text(), re.MULTILINE):
            waiting += [path for at in (file.parent, *folders) if (path := at / name).exists()][:1]
    return found


@functools.cache
def library(kernels: Path, contract: bool, into: Path | None, instrument: bool = True) -> ctypes.CDLL:
    """A .cu file as a shared library, built where it is missing.

    Args: `contract`: with fused multiply-adds. `into`: a folder in which warnings are no errors.
    `instrument`: the compiler adds the checks of accesses.
    Raises CalledProcessError if it does not compile.
    """
    runtime = _runtime()
    checks = INSTRUMENTED if instrument else ("-O2",)
    flags = (
        *KERNELS,
        *checks,
        *(CONTRACTED if contract else ("-ffp-contract=off",)),
        "-w" if into else "-Werror",
    )
    folders = (kernels.parent, kernels.parent.parent, CSRC, CSRC / "cuda", HERE)
    names = re.findall(r"__launch_bounds__\(\d+\)\s+(\w+)\(", kernels.read_text())
    exports = "".join(f"CUDA_HOST_EXPORT({name})\n" for name in names)
    program = f'#include "{HERE / "host.h"}"\n#include "{kernels}"\n{exports}'
    code = [*included(kernels, folders), *included(HERE / "host.h", folders), Path(__file__)]
    includes = [f"-I{folder}" for folder in folders]
    path = (into or BUILD) / f"{kernels.stem}-{_digest(code, program, flags, runtime)}.so"

    def build(part: Path) -> None:
        source, assembly = path.with_suffix(".cpp"), path.with_suffix(".s")
        source.write_text(program)
        _compile("-S", *flags, *includes, str(source), "-o", str(assembly))
        assembly.write_text(with_guards(assembly.read_text()))
        _compile("-shared", str(assembly), str(runtime), "-o", str(part))
        assembly.unlink()

    _once(path, build)
    return ctypes.CDLL(str(path))


@functools.cache
def _runtime() -> Path:
    sources = [HERE / "threads.cpp", HERE / "memory.cpp"]
    path = BUILD / f"runtime-{_digest([*sources, HERE / 'emulation.h'], RUNTIME)}.so"
    _once(path, lambda part: _compile("-shared", *RUNTIME, *map(str, sources), "-o", str(part)))
    return path


def _once(path: Path, build: Callable[[Path], None]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:  # the tests may run in several processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            build(part := path.with_suffix(".part"))
            part.replace(path)


def _digest(files: list[Path], *others: object) -> str:
    code = b"".join(file.read_bytes() for file in files)
    return hashlib.sha256(code + repr((_compiler(), others)).encode()).hexdigest()[:16]


@functools.cache
def _compiler() -> str:
    compiler = os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    return compiler


def _compile(*arguments: str) -> None:
    subprocess.run([_compiler(), *arguments], check=True, timeout=300)


def with_guards(assembly: str) -> str:
    """Assembly with unused bytes after each variable in the section cuda_shared, and a table of them.

    So that the end of one variable is not the start of the next, which only the linker could tell apart.
    """
    lines, table, inside = [], [], False
    sizes = dict(re.findall(r"^\t\.size\t(\S+), (\d+)$", assembly, re.MULTILINE))
    for line in assembly.splitlines():
        if re.match(r"\t\.(section|text|data|bss)\b", line):
            inside = "cuda_shared" in line
        lines.append(line)
        if inside and (label := re.fullmatch(r"(\w\S*):", line)):
            table.append(label[1])
        if inside and re.match(r"\t\.zero\t", line):
            lines.append(f"\t.zero\t{GUARD}")
    lines.append('\t.section\tcuda_variables,"aw"')
    for number, symbol in enumerate(table):
        lines.append(f"\t.quad\t.Lname{number}, {symbol}, {sizes[symbol]}")
    lines.append("\t.section\t.rodata")
    lines += [f'.Lname{number}:\n\t.string\t"{_name(symbol)}"' for number, symbol in enumerate(table)]
    return "\n".join(lines) + "\n"


def _name(symbol: str) -> str:
    """Of a static variable in a function `extern "C"`: its own name, without the function's."""
    words = []
    rest = symbol
    while match := re.search(r"(\d+)(?=[A-Za-z_])", rest):
        start, length = match.end(), int(match[1])
        words.append(rest[start : start + length])
        rest = rest[start + length :]
    return f"shared {words[-1]}" if words else symbol


def line_of(path: str, offset: int) -> str:
    """The line of the kernels' source that code at an offset in a library is of: file.cu:12."""
    found = subprocess.run(
        ["addr2line", "-i", "-e", path, hex(offset)], check=True, capture_output=True, text=True
    ).stdout
    own = [line for line in found.splitlines() if not line.startswith(str(HERE))]
    return Path(own[0].split(" ")[0]).name if own else hex(offset)
