"""Compilation by NVRTC and its cache, without a card and without a driver."""

import shutil
import sys
from pathlib import Path

import pytest

from panolog.renderer.cuda import nvrtc
from panolog.scene.errors import InputError

pytestmark = pytest.mark.system

pytest.importorskip("cuda.core", reason="needs cuda-core: pip install cuda-core")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "panolog" / "cuda"


def test_every_source_is_a_module() -> None:
    found = {file.stem for file in (nvrtc.CSRC / "cuda").glob("*.cu")}
    assert found == set(nvrtc.MODULES)


def test_compiled_code_is_kept_and_found_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = nvrtc.cubin("adam", "sm_89")
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr(nvrtc, "compile_module", None)
    assert nvrtc.cubin("adam", "sm_89") == code


def test_another_compiler_or_architecture_compiles_again(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nvrtc.cubin("adam", "sm_89")
    nvrtc.cubin("adam", "sm_90")
    architectures = nvrtc.nvrtc_version()[2]
    monkeypatch.setattr(nvrtc, "nvrtc_version", lambda: (99, 0, architectures))
    nvrtc.cubin("adam", "sm_90")
    assert len(list(cache.iterdir())) == 3


@pytest.mark.parametrize("header", ["formulas.h", "footprint.h", "cuda/common.cuh"])
def test_a_changed_source_compiles_again(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header: str
) -> None:
    sources = tmp_path / "csrc"
    shutil.copytree(nvrtc.CSRC, sources)
    monkeypatch.setattr(nvrtc, "CSRC", sources)
    nvrtc.cubin("adam", "sm_89")
    with (sources / header).open("a") as file:
        file.write("// changed\n")
    nvrtc.cubin("adam", "sm_89")
    assert len(list(cache.iterdir())) == 2


def test_a_cache_that_cannot_be_written_costs_only_time(cache: Path) -> None:
    cache.parent.write_text("a file where the folder should be")
    assert nvrtc.cubin("adam", "sm_89")[:4] == b"\x7fELF"


def test_an_architecture_that_nvrtc_does_not_know() -> None:
    with pytest.raises(InputError, match="not for sm_999: pip install"):
        nvrtc.compile_module("adam", "sm_999")


def test_cuda_core_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cuda.core", None)
    with pytest.raises(InputError, match=r"needs cuda-core .*: pip install cuda-core"):
        nvrtc.nvrtc_version.__wrapped__()


def test_nvrtc_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise RuntimeError("libnvrtc.so.13 was not found\nin any of many places")

    monkeypatch.setattr("cuda.bindings.nvrtc.nvrtcVersion", fail)
    with pytest.raises(InputError, match=r"needs NVRTC \(libnvrtc.so.13 was not found\): pip install"):
        nvrtc.nvrtc_version.__wrapped__()
