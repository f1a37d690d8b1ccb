"""Compilation of csrc/cuda by NVRTC, for one architecture at a time, with a cache on disk.

Needs the wheels cuda-core and nvidia-cuda-nvrtc: no CUDA toolkit, no driver, no card.
"""

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import re
import stat
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from panolog.scene.errors import DeviceError
from panolog.scene.files import user_folder, write_bytes

if TYPE_CHECKING:
    from cuda.core import Program, ProgramOptions

T = TypeVar("T")

CSRC = Path(__file__).parents[1] / "csrc"

# Options of each file in csrc/cuda besides the common ones; the files give the reasons.
MODULES: dict[str, dict[str, bool]] = {
    "project": {"fma": False},
    "bin": {"fma": False},
    "composite": {"use_fast_math": True},
    "loss": {},
    "iteration": {},
}

DIGEST = 32  # bytes of SHA-256 at the end of a file of the cache

_LOG = logging.getLogger(__name__)


def code(module: str, arch: str) -> bytes:
    """csrc/cuda/{module}.cu for the driver of a card such as "sm_89", from the cache on disk if it has it.

    That is machine code, or, for a card that is newer than NVRTC, PTX which the driver compiles.

    Raises:
        DeviceError: cuda-core or NVRTC is missing, or all architectures that this NVRTC knows are newer.
    """
    known, kind = target(arch)
    folder = cache_folder()
    path = folder / f"{module}-{known}-{_key(module, known)}.{kind}" if folder else None
    if path and (cached := _cached(path)):
        _LOG.info("CUDA kernels: %s read from %s", module, path)
        return cached
    _LOG.info("CUDA kernels: compiling %s to %s of %s, for %s", module, kind, known, arch)
    made = compile_module(module, known, kind)
    if path:
        with contextlib.suppress(OSError):  # a cache that cannot be written costs time, nothing else
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, made + hashlib.sha256(made).digest())
    return made


def target(arch: str) -> tuple[str, str]:
    """What to compile for a card: an architecture that NVRTC knows, and whether to "cubin" or "ptx".

    Raises DeviceError as `code`.
    """
    major, minor, architectures = nvrtc_version()
    if arch in architectures:
        return arch, "cubin"
    if older := [known for known in architectures if _number(known) < _number(arch)]:
        return max(older, key=_number), "ptx"
    known = ", ".join(architectures)
    raise DeviceError(
        f"NVRTC {major}.{minor} compiles for {known}, not for {arch}: pip install -U nvidia-cuda-nvrtc"
    )


def _number(arch: str) -> int:
    """The number of an architecture: 89 of "sm_89"."""
    return int(arch.removeprefix("sm_"))


def _cached(path: Path) -> bytes | None:
    """The code in a file of the cache; None if there is no such file, or if it is not as it was written."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    code, digest = data[:-DIGEST], data[-DIGEST:]
    if hashlib.sha256(code).digest() == digest:
        return code
    _LOG.warning("CUDA kernels: %s is damaged and made again", path)
    return None


def compile_module(module: str, arch: str, kind: str = "cubin") -> bytes:
    """csrc/cuda/{module}.cu for an architecture that NVRTC knows. Args: kind, "cubin" or "ptx"."""
    made = bytes(program(module, arch).compile(kind).code)
    return made if kind == "cubin" else made.rstrip(b"\0") + b"\0"  # the driver reads PTX up to there


def program(module: str, arch: str, **options: Any) -> "Program":
    """csrc/cuda/{module}.cu to be compiled for an architecture; `options` of `cuda.core.ProgramOptions`.

    Raises DeviceError if NVRTC does not know the architecture, or as `nvrtc_version`.
    """
    if target(arch)[0] != arch:
        raise DeviceError(f"NVRTC does not know {arch}: pip install -U nvidia-cuda-nvrtc")
    from cuda.core import Program  # noqa: PLC0415  # optional: only rendering on a GPU needs it

    return Program((CSRC / "cuda" / f"{module}.cu").read_text(), "c++", settings(module, arch, **options))


def settings(module: str, arch: str, **options: Any) -> "ProgramOptions":
    """With what a kernel file is compiled for a real or a virtual architecture ("sm_89", "compute_89")."""
    from cuda.core import ProgramOptions  # noqa: PLC0415  # optional, as above

    return ProgramOptions(
        name=f"{module}.cu",
        arch=arch,
        std="c++17",
        include_path=[str(CSRC), str(CSRC / "cuda")],
        **MODULES[module],
        **options,
    )


@functools.cache
def nvrtc_version() -> tuple[int, int, tuple[str, ...]]:
    """Major and minor version of the CUDA that NVRTC is of, and the architectures that it compiles for.

    Raises:
        DeviceError: cuda-core or NVRTC is missing.
    """
    _load_that_of_torch()
    try:
        from cuda.bindings import nvrtc  # noqa: PLC0415  # optional: only rendering on a GPU needs it
        from cuda.core import Program  # noqa: F401, PLC0415
    except ImportError as error:
        raise DeviceError(
            f"rendering on a GPU needs cuda-core ({error}): pip install cuda-core cuda-bindings, "
            "or use --device cpu"
        ) from error
    try:
        _, major, minor = nvrtc.nvrtcVersion()
    except RuntimeError as error:  # the library is not found, or does not load
        raise DeviceError(
            f"rendering on a GPU needs NVRTC ({_first_line(error)}): pip install nvidia-cuda-nvrtc, "
            "or use --device cpu"
        ) from error
    _, architectures = nvrtc.nvrtcGetSupportedArchs()
    return major, minor, tuple(f"sm_{number}" for number in architectures)


def _load_that_of_torch() -> None:
    """Loads the NVRTC of torch's CUDA, if pip has installed it: cuda-bindings takes what is loaded.

    Of several it would take the newest, whose code a driver that is new enough for torch may not load.
    """
    spec, major = find_spec("nvidia"), (torch.version.cuda or "").partition(".")[0]
    for folder in (spec.submodule_search_locations or []) if spec and major else []:
        for library in (f"libnvrtc-builtins.so.{major}.*", f"libnvrtc.so.{major}"):
            for path in Path(folder).glob(f"*/lib/{library}"):
                with contextlib.suppress(OSError):  # a damaged one: cuda-bindings looks for another
                    ctypes.CDLL(str(path), os.RTLD_NOW | os.RTLD_GLOBAL)


def module_of(kernel: str) -> str:
    """The file in csrc/cuda that has a kernel: its name begins with that of the file."""
    return kernel.split("_", maxsplit=1)[0]


def in_order(source: Path, kernel: str, arguments: Mapping[str, T]) -> list[T]:
    """Arguments of a kernel in the order of its parameters in a .cu file.

    Raises:
        TypeError: the names are not those of the parameters.
    """
    names = _parameters(source)[kernel]
    if arguments.keys() != set(names):
        raise TypeError(f"the kernel {kernel} takes {', '.join(names)}, not {', '.join(arguments)}")
    return [arguments[name] for name in names]


@functools.cache
def _parameters(source: Path) -> dict[str, tuple[str, ...]]:
    """The kernels of a .cu file with the names of their parameters."""
    kernels = re.findall(r"__launch_bounds__\(\d+\)\s+(\w+)\(([^)]*)\)", source.read_text())
    return {name: tuple(re.findall(r"(\w+)\s*(?:,|$)", parameters)) for name, parameters in kernels}


def cache_folder() -> Path | None:
    """The folder of compiled kernels, in the user's cache (XDG).

    Without a home it is a temporary folder of this user, or None if others may write there.
    """
    if own := user_folder("XDG_CACHE_HOME", ".cache"):
        return own / "cuda"
    folder = Path(tempfile.gettempdir()) / f"panolog-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return folder / "cuda"
    return None


def _key(module: str, arch: str) -> str:
    """A digest of all that the machine code depends on."""
    digest = hashlib.sha256(repr((module, arch, MODULES[module], nvrtc_version())).encode())
    for source in (*sorted(CSRC.glob("*.h")), *sorted((CSRC / "cuda").glob("*.cu*"))):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:32]


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
