"""The CUDA kernels on the host: built by the C++ compiler that is there, launched as on a card."""

import ctypes
import fcntl
import functools
import hashlib
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from torch import Tensor

from panolog.renderer.cuda.launches import Argument
from panolog.renderer.cuda.nvrtc import CSRC, in_order

HEADER = Path(__file__).parent / "host.h"
BUILD = Path(__file__).parents[4] / "build" / "emulation"
FLAGS = (
    "-std=c++17",
    "-O2",
    "-g",
    "-fPIC",
    "-shared",
    "-ffp-contract=off",
    "-U_FORTIFY_SOURCE",
    "-Wall",
    "-Werror",
)
QUIET = ("-Wno-unused-function", "-Wno-unknown-pragmas", "-Wno-clobbered")


@functools.cache
def library(kernels: Path) -> ctypes.CDLL:
    """A .cu file as a shared library, built where it is missing."""
    compiler = os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    code = [HEADER, kernels, CSRC / "formulas.h", *sorted((CSRC / "cuda").glob("*.cuh"))]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in code) + repr(FLAGS).encode()).hexdigest()
    path = BUILD / f"{kernels.stem}-{digest[:16]}.so"
    BUILD.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:  # the tests may run in several processes
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            _build(compiler, kernels, path)
    return ctypes.CDLL(str(path))


def _build(compiler: str, kernels: Path, path: Path) -> None:
    source, made = path.with_suffix(".cpp"), path.with_suffix(".part")
    names = re.findall(r"__launch_bounds__\(\d+\)\s+(\w+)\(", kernels.read_text())
    exports = "".join(f"CUDA_HOST_EXPORT({name})\n" for name in names)
    source.write_text(f'#include "{HEADER}"\n#include "{kernels}"\n{exports}')
    includes = (f"-I{CSRC}", f"-I{CSRC / 'cuda'}")
    subprocess.run([compiler, *FLAGS, *QUIET, *includes, str(source), "-o", str(made)], check=True)
    made.replace(path)


class EmulatedLaunch:
    """A `Launch` whose device is the host. Fails where a card would hang or behave undefined."""

    def __init__(self, folder: Path = CSRC / "cuda", *, backwards: bool = False) -> None:
        """`folder`: of the .cu files; `backwards`: the last thread of a block runs first."""
        self.folder = folder
        self.backwards = backwards

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        module = kernel.split("_", maxsplit=1)[0]
        source = self.folder / f"{module}.cu"
        run = getattr(library(source), f"run_{kernel}")
        run.restype = ctypes.c_char_p
        kinds, values = zip(*map(_raw, in_order(source, kernel, arguments)), strict=True)
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        error = run((ctypes.c_uint * 2)(*grid), block, int(self.backwards), "".join(kinds).encode(), pointers)
        if error is not None:
            raise AssertionError(f"{kernel}: {error.decode()}")


def _raw(
    argument: Argument,
) -> tuple[str, ctypes.c_void_p | ctypes.c_float | ctypes.c_int64 | ctypes.Array[ctypes.c_char]]:
    """Kind and value as the kernel takes it: pointers, integers as 64 bits, floats as 32, structs whole."""
    if isinstance(argument, bytes):
        return f"b{len(argument)}", ctypes.create_string_buffer(argument, len(argument))
    if isinstance(argument, Tensor):
        assert argument.is_contiguous()
        return "p", ctypes.c_void_p(argument.data_ptr())
    if isinstance(argument, float):
        return "f", ctypes.c_float(argument)
    return ("p", ctypes.c_void_p(None)) if argument is None else ("i", ctypes.c_int64(argument))
