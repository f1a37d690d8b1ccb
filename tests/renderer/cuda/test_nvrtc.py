"""Compilation by NVRTC and its cache, without NVRTC: test_driver.py and test_resources.py compile."""

import os
import pwd
import shutil
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from panolog.renderer.cuda import nvrtc
from panolog.scene.errors import InputError

Compiled = list[tuple[str, str]]
VERSION = nvrtc.nvrtc_version.__wrapped__  # not the cached answer


@pytest.fixture(autouse=True)
def compiled(monkeypatch: pytest.MonkeyPatch) -> Compiled:
    """What a stand-in for NVRTC has compiled."""
    made: Compiled = []

    def compile_module(module: str, arch: str, kind: str) -> bytes:
        made.append((module, arch))
        return f"{kind} of {module} for {arch}".encode() * 100

    monkeypatch.setattr(nvrtc, "compile_module", compile_module)
    monkeypatch.setattr(nvrtc, "nvrtc_version", lambda: (13, 0, ("sm_89", "sm_90")))
    return made


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "panolog" / "cuda"


def test_every_source_is_a_module() -> None:
    found = {file.stem for file in (nvrtc.CSRC / "cuda").glob("*.cu")}
    assert found == set(nvrtc.MODULES)


def test_code_is_compiled_once_for_each_compiler_and_architecture(
    cache: Path, compiled: Compiled, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = nvrtc.code("bin", "sm_89")
    assert nvrtc.code("bin", "sm_89") == first != nvrtc.code("bin", "sm_90")
    assert nvrtc.code("loss", "sm_89") != first
    monkeypatch.setattr(nvrtc, "nvrtc_version", lambda: (99, 0, ("sm_89", "sm_90")))
    nvrtc.code("bin", "sm_89")
    assert compiled == [("bin", "sm_89"), ("bin", "sm_90"), ("loss", "sm_89"), ("bin", "sm_89")]
    assert len(list(cache.iterdir())) == 4


def test_a_card_that_is_newer_than_the_compiler_gets_ptx_of_the_newest_that_is_older(cache: Path) -> None:
    assert nvrtc.code("bin", "sm_120").startswith(b"ptx of bin for sm_90")
    assert nvrtc.code("bin", "sm_90").startswith(b"cubin of bin for sm_90")
    assert {path.suffix for path in cache.iterdir()} == {".cubin", ".ptx"}


def test_a_changed_source_compiles_again(
    cache: Path, compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = tmp_path / "csrc"
    shutil.copytree(nvrtc.CSRC, sources)
    monkeypatch.setattr(nvrtc, "CSRC", sources)
    nvrtc.code("bin", "sm_89")
    for times, header in enumerate(("formulas.h", "footprint.h", "cuda/common.cuh"), start=2):
        with (sources / header).open("a") as file:
            file.write("// changed\n")
        nvrtc.code("bin", "sm_89")
        assert len(compiled) == len(list(cache.iterdir())) == times


@pytest.mark.parametrize("damage", ["empty", "cut", "changed", "longer"])
def test_damaged_code_is_compiled_once_more(cache: Path, compiled: Compiled, damage: str) -> None:
    code = nvrtc.code("bin", "sm_89")
    (file,) = cache.iterdir()
    data = file.read_bytes()
    changed = data[:500] + bytes([data[500] ^ 1]) + data[501:]
    file.write_bytes({"empty": b"", "cut": data[:-100], "changed": changed, "longer": data + b"?"}[damage])
    for _ in range(2):
        assert nvrtc.code("bin", "sm_89") == code
    assert len(compiled) == 2


@pytest.fixture
def no_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder of a container whose user has no entry: Path.home() raises RuntimeError."""

    def unknown(uid: int) -> None:
        raise KeyError(uid)

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_without_a_home_code_is_kept_in_a_temporary_folder(no_home: Path, compiled: Compiled) -> None:
    assert nvrtc.code("bin", "sm_89") == nvrtc.code("bin", "sm_89")
    (folder,) = no_home.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(compiled) == 1


@pytest.mark.parametrize("kind", ["a link", "writable by others", "a file"])
def test_a_temporary_folder_of_others_is_not_used(no_home: Path, kind: str) -> None:
    folder = no_home / f"panolog-{os.getuid()}"
    match kind:
        case "a link":
            (no_home / "elsewhere").mkdir()
            folder.symlink_to(no_home / "elsewhere")
        case "writable by others":
            folder.mkdir()
            folder.chmod(0o777)
        case _:
            folder.write_text("")
    assert nvrtc.cache_folder() is None
    assert nvrtc.code("bin", "sm_89").startswith(b"cubin of bin for sm_89")
    assert not list(no_home.rglob("*.cubin"))


def test_a_cache_that_cannot_be_written_costs_only_time(cache: Path) -> None:
    cache.parent.write_text("a file where the folder should be")
    assert nvrtc.code("bin", "sm_89").startswith(b"cubin of bin for sm_89")


def test_what_is_missing_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise RuntimeError("libnvrtc.so.13 was not found\nin any of many places")

    with pytest.raises(InputError, match="not for sm_75: pip install"):
        nvrtc.code("bin", "sm_75")
    with pytest.raises(InputError, match="does not know sm_999: pip install"):
        nvrtc.program("bin", "sm_999")
    if find_spec("cuda.core"):
        monkeypatch.setattr("cuda.bindings.nvrtc.nvrtcVersion", fail)
        with pytest.raises(InputError, match=r"needs NVRTC \(libnvrtc.so.13 was not found\): pip install"):
            VERSION()
    monkeypatch.setitem(sys.modules, "cuda.core", None)
    with pytest.raises(InputError, match=r"needs cuda-core .*: pip install cuda-core"):
        VERSION()
