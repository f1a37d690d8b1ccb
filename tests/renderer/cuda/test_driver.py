"""Launches down to the driver: what it copies from each is what the kernel's parameters are in the cubin."""

import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from panolog.renderer.cuda import nvrtc

pytest.importorskip("cuda.core", reason="CUDA: no cuda-core")
from cuda.bindings import driver

pytestmark = pytest.mark.system

HERE = Path(__file__).parent
ARCH, UNKNOWN = "sm_89", "sm_999"  # the second is newer than every NVRTC
KPARAM_INFO, SIZED = 0x17, 0x04  # EIATTR_KPARAM_INFO of a cubin's .nv.info, and the format of its entry


def sections(elf: bytes) -> Iterator[tuple[str, bytes]]:
    """The named parts of a 64-bit little-endian ELF file."""
    (at,), (size, count, names) = struct.unpack_from("<Q", elf, 0x28), struct.unpack_from("<3H", elf, 0x3A)
    heads = [struct.unpack_from("<2I4Q", elf, at + size * i) for i in range(count)]
    for name, _kind, _flags, _address, begin, length in heads:
        start = heads[names][4] + name
        yield elf[start : elf.index(b"\0", start)].decode(), elf[begin : begin + length]


def parameters(cubin: bytes) -> dict[str, list[int]]:
    """The bytes of each parameter of each kernel, from what the compiler wrote for the driver."""
    found: dict[str, dict[int, int]] = {}
    for name, content in sections(cubin):
        at = 0
        while name.startswith(".nv.info.") and at < len(content):
            form, attribute, length = struct.unpack_from("<2BH", content, at)
            at += 4
            if form != SIZED:
                continue
            if attribute == KPARAM_INFO:
                _, ordinal, _offset, flags = struct.unpack_from("<I2HI", content, at)
                found.setdefault(name.removeprefix(".nv.info."), {})[ordinal] = flags >> 18
            at += length
    return {kernel: [sizes[i] for i in range(len(sizes))] for kernel, sizes in found.items()}


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """With a driver that has no card, and compiled kernels."""
    folder = tmp_path_factory.mktemp("driver")
    compiler = os.environ.get("CXX", "c++")
    library = folder / "libcuda.so.1"
    options = ("-shared", "-fPIC", "-Wall", "-Werror", f"-Wl,-soname,{library.name}", "-o", str(library))
    subprocess.run([compiler, str(HERE / "libcuda.cpp"), *options, "-ldl"], check=True)
    paths = [str(folder), *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
    return os.environ | {"LD_LIBRARY_PATH": ":".join(paths), "XDG_CACHE_HOME": str(folder)}


@pytest.mark.parametrize("arch", [ARCH, pytest.param(UNKNOWN, marks=pytest.mark.nightly)])
def test_the_driver_copies_what_each_kernel_takes(
    arch: str, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also on a card that NVRTC does not know, which compiles PTX."""
    monkeypatch.setenv("XDG_CACHE_HOME", environment["XDG_CACHE_HOME"])
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (driver.CUresult.CUDA_SUCCESS, 13000))
    sizes: dict[str, list[int]] = {}
    for module in nvrtc.MODULES:
        sizes |= parameters(nvrtc.code(module, ARCH))
        nvrtc.code(module, arch)  # the stubbed driver of the other process lacks calls that NVRTC makes
    assert sizes["project_forward"] == [8] * 7 + [64] + [8] * 6
    assert sizes["project_step"] == [6 * 48 + 16, 64] + [8] * 9
    command = [sys.executable, "-m", "tests.renderer.cuda.driver_calls", arch, repr(sizes)]
    done = subprocess.run(
        command, env=environment, cwd=HERE.parents[2], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) == sizes.keys()


NVRTC_12 = """
extern "C" {
int nvrtcVersion(int* major, int* minor) { *major = 12, *minor = 6; return 0; }
int nvrtcGetNumSupportedArchs(int* count) { *count = 1; return 0; }
int nvrtcGetSupportedArchs(int* archs) { *archs = 90; return 0; }
}
"""


@pytest.mark.parametrize("cuda", ["12.6", "13.0"])
def test_of_two_nvrtc_that_of_torchs_cuda_is_taken(cuda: str, tmp_path: Path) -> None:
    """A driver of CUDA 12 cannot load what NVRTC 13 makes."""
    folder = tmp_path / "nvidia" / "cuda_nvrtc" / "lib"
    folder.mkdir(parents=True)
    library = folder / "libnvrtc.so.12"
    options = ("-shared", "-fPIC", "-x", "c++", "-", f"-Wl,-soname,{library.name}", "-o", str(library))
    subprocess.run([os.environ.get("CXX", "c++"), *options], input=NVRTC_12, text=True, check=True)
    code = (
        f"import torch; torch.version.cuda = '{cuda}'\n"
        "from panolog.renderer.cuda import nvrtc\n"
        "print(*nvrtc.nvrtc_version()[:2], sep='.')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip().startswith(cuda if cuda == "12.6" else "13.")


def test_a_driver_that_refuses_is_named(environment: dict[str, str]) -> None:
    code = (
        "from panolog.renderer.cuda import card, nvrtc\n"
        "nvrtc.code = lambda module, arch: b'no code'\n"
        "card.Kernels('sm_89').launch(1, 'loss_absolute', (1, 1), 256, {})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, check=False, capture_output=True, text=True
    )
    assert "RunError: loading loss failed on the GPU: CUDA_ERROR_INVALID_IMAGE" in done.stderr
