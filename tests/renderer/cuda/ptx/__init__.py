"""The PTX that NVRTC makes of the CUDA kernels, executed in the host's emulation.

What g++ makes of the sources shares neither NVRTC's choices (fused multiply-adds, flushed subnormals, wide
loads, predicates) nor its faults. Here its own code runs: `program.py` reads it, `translation.py` turns each
instruction into a statement of C++ by `rules.py`, and `ptx.h` has what instructions do. What is unknown is an
error.
"""

import ctypes
import functools
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import pytest

from panolog.renderer.cuda.nvrtc import CSRC, MODULES, settings
from panolog.scene.files import write_bytes
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.emulation.build import BUILD
from tests.renderer.cuda.ptx.translation import translate

# Where approximate instructions lie in what the ISA allows them: PTX_ERROR of ptx.h.
NEAREST, HIGHEST, LOWEST, EITHER = 0, 1, -1, 2


@dataclass(frozen=True)
class Program:
    """All modules as one compiler makes them, and how approximate instructions round."""

    arch: str
    cuda12: bool = False  # by NVRTC of CUDA 12 instead of the installed one
    error: int = NEAREST


# Those that run. What the compilers make for other architectures equals one of them: test_translation.py.
PROGRAMS = {
    "sm_89": Program("sm_89"),
    "sm_120": Program("sm_120"),
    "sm_89_worst": Program("sm_89", error=EITHER),
    "sm_120_worst": Program("sm_120", error=EITHER),
    "sm_89_older": Program("sm_89", cuda12=True),
    "sm_120_older": Program("sm_120", cuda12=True),
}


def emulated_ptx(program: Program, *, seed: int = 0) -> EmulatedLaunch:
    """A launch of what a compiler makes of csrc/cuda."""
    folder = sources(program)
    return EmulatedLaunch(folder, seed=seed, into=folder, instrument=False)


@functools.cache
def sources(program: Program) -> Path:
    """A folder with a program's modules as C++."""
    name = f"{program.arch}{'_cuda12' if program.cuda12 else ''}_{program.error}"
    folder = BUILD / "ptx" / name
    folder.mkdir(parents=True, exist_ok=True)
    for module in MODULES:
        code = translated(module, program, ptx_of(module, program.arch, program.cuda12))
        write_bytes(folder / f"{module}.cu", code.encode())
    return folder


def translated(module: str, program: Program, ptx: str) -> str:
    """The C++ of a module's PTX."""
    return translate(ptx, (CSRC / "cuda" / f"{module}.cu").read_text(), f"{module}.ptx", program.error)


@functools.cache
def ptx_of(module: str, arch: str, cuda12: bool = False) -> str:
    """What NVRTC makes of a module for an architecture such as "sm_89"."""
    library = ctypes.CDLL(str(_nvrtc_of_cuda12() if cuda12 else _installed_nvrtc()))
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    source = (CSRC / "cuda" / f"{module}.cu").read_bytes()
    options = settings(module, arch.replace("sm_", "compute_")).as_bytes("nvrtc")
    given = (ctypes.c_char_p * len(options))(*options)
    name = f"{module}.cu".encode()
    _check(library, library.nvrtcCreateProgram(ctypes.byref(program), source, name, 0, None, None))
    try:
        _check(library, library.nvrtcCompileProgram(program, len(options), given))
        _check(library, library.nvrtcGetPTXSize(program, ctypes.byref(size)))
        text = ctypes.create_string_buffer(size.value)
        _check(library, library.nvrtcGetPTX(program, text))
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))
    return text.value.decode()


def _installed_nvrtc() -> Path:
    pathfinder = pytest.importorskip("cuda.pathfinder", reason="CUDA: no cuda-core")
    return Path(pathfinder.load_nvidia_dynamic_lib("nvrtc").abs_path)


def _nvrtc_of_cuda12() -> Path:
    """Of the wheel nvidia-cuda-nvrtc-cu12, which `make nightly` installs."""
    try:
        (library,) = (
            Path(str(each.locate()))
            for each in files("nvidia-cuda-nvrtc-cu12") or ()
            if each.name == "libnvrtc.so.12"
        )
    except PackageNotFoundError:
        pytest.skip("CUDA: no nvidia-cuda-nvrtc-cu12")
    return library


def _check(library: ctypes.CDLL, result: int) -> None:
    if result:
        library.nvrtcGetErrorString.restype = ctypes.c_char_p
        raise RuntimeError(f"NVRTC: {library.nvrtcGetErrorString(result).decode()}")
