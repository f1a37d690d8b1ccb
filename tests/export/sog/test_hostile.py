"""Damaged and hostile SOGs: one line, or valid Gaussians; neither a traceback nor memory for nothing."""

import io
import json
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from panolog.export.sog.read import read_sog
from panolog.export.sog.write import write_sog
from panolog.scene.errors import FormatError
from tests.export.gaussians import line_of
from tests.export.sog.models import source, write_unpacked

Change = Callable[[dict[str, Any]], object]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sog")
    write_sog(folder / "a.sog", source(300))
    write_unpacked(folder / "files", source(300))
    return folder


def changed_meta(whole: Path, folder: Path, change: Change) -> Path:
    for file in (whole / "files").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    meta = json.loads((folder / "meta.json").read_text())
    change(meta)
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda meta: meta.update(version=3), "is of version 3"),
        (lambda meta: meta.update(count=10**9), "no whole number from 1"),
        (lambda meta: meta.update(count=30_000_000), "30,000,000 Gaussians cannot be in"),
        (lambda meta: meta.update(count=1000), "pixels for 1,000 Gaussians"),
        (lambda meta: meta["means"].update(mins=[0, 0]), r"no 3 numbers of up to ±80 as means\.mins"),
        (lambda meta: meta["means"].update(maxs=[0, 0, float("nan")]), r"as means\.maxs"),
        (lambda meta: meta["scales"].update(codebook=[1.0] * 255), r"no 256 numbers .* as scales\.codebook"),
        (lambda meta: meta["quats"].update(files=[7]), r"names no 1 images as quats\.files"),
        (
            lambda meta: meta["quats"].update(files=["../quats.webp"]),
            "is not the name of a file in this folder",
        ),
        (lambda meta: meta["quats"].update(files=["nowhere.webp"]), "missing, although meta.json names it"),
        (lambda meta: meta["quats"].update(files=["meta.json"]), "no WebP or PNG"),
        (lambda meta: meta["quats"].update(files=["means_l.webp"]), ""),  # its alpha is 255: a valid form
        (lambda meta: meta["quats"].update(files=["sh0.webp"]), "quaternions have a reserved form"),
        (lambda meta: meta["shN"].update(count=3), "of a palette of 3"),
        (lambda meta: meta["shN"].update(count=65_537), r"as shN\.count"),
        (lambda meta: meta.pop("sh0"), "has no sh0"),
    ],
)
def test_wrong_meta(whole: Path, tmp_path: Path, change: Change, line: str) -> None:
    folder = changed_meta(whole, tmp_path, change)
    if line:
        with pytest.raises(FormatError, match=line):
            read_sog(folder)
    assert bool(line_of(folder)) == bool(line)


@pytest.mark.parametrize("text", ["", "[", "[" * 100_000, "1", '{"count": 1e999}', "9" * 5000, "\udcff"])
def test_meta_that_is_none(whole: Path, tmp_path: Path, text: str) -> None:
    changed_meta(whole, tmp_path, lambda meta: None)
    (tmp_path / "meta.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    assert "meta.json" in line_of(tmp_path)


def test_early_files_without_first_entry(whole: Path, tmp_path: Path) -> None:
    folder = changed_meta(whole, tmp_path, lambda meta: meta["scales"]["codebook"].__setitem__(0, None))
    assert len(read_sog(folder)) == 300


def test_missing(tmp_path: Path) -> None:
    for path in (tmp_path / "a.sog", tmp_path / "meta.json"):
        with pytest.raises(FormatError, match=r"there is no SOG; give a \.sog file"):
            read_sog(path)
    with pytest.raises(FormatError, match=r"meta\.json: missing"):
        read_sog(tmp_path)


def bundle(path: Path, whole: Path, **changed: bytes) -> Path:
    """Deflated. Args: whole, of the module; changed files, without the ends of their names."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (whole / "files").iterdir():
            archive.writestr(file.name, changed.get(file.stem, file.read_bytes()))
    return path


def peak(path: Path) -> tuple[str, int]:
    """The line of an error, and the memory that it took."""
    tracemalloc.start()
    try:
        return line_of(path), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_deflated_bundles_are_read(whole: Path, tmp_path: Path) -> None:
    found = read_sog(bundle(tmp_path / "a.sog", whole))
    np.testing.assert_array_equal(found.means, read_sog(whole / "a.sog").means)


def test_zip_bombs(whole: Path, tmp_path: Path) -> None:
    line, bytes_taken = peak(bundle(tmp_path / "a.sog", whole, means_l=bytes(2**28)))
    assert "larger than the" in line and bytes_taken < 2**24
    bomb = bundle(tmp_path / "b.sog", whole, meta=b" " * 2**26)
    line, bytes_taken = peak(bomb)
    assert "larger than the 1,048,576 bytes" in line and bytes_taken < 2**24
    data, at = bytearray(bomb.read_bytes()), 0
    while (at := data.find(b"PK\1\2", at)) >= 0:
        struct.pack_into("<I", data, at + 24, 1000)  # of what is deflated, less than there is
        at += 4
    bomb.write_bytes(data)
    line, bytes_taken = peak(bomb)
    assert line and bytes_taken < 2**24


@pytest.mark.parametrize(
    ("record", "at", "value", "line"),
    [(b"PK\5\6", 12, 2**31, "not a whole .sog"), (b"PK\1\2", 20, 1, "means_l.webp is damaged")],
)
def test_wrong_directories(
    whole: Path, tmp_path: Path, record: bytes, at: int, value: int, line: str
) -> None:
    data = bytearray((whole / "a.sog").read_bytes())
    struct.pack_into("<I", data, data.index(record) + at, value)
    (tmp_path / "a.sog").write_bytes(data)
    assert line in line_of(tmp_path / "a.sog")


def test_image_bombs(whole: Path, tmp_path: Path) -> None:
    flat = io.BytesIO()
    Image.new("RGB", (8000, 8000)).save(flat, "WEBP", lossless=True)
    assert len(flat.getvalue()) < 100_000
    folder = changed_meta(whole, tmp_path, lambda meta: None)
    (folder / "means_u.webp").write_bytes(flat.getvalue())
    line, bytes_taken = peak(folder)
    assert "no WebP or PNG of up to" in line and bytes_taken < 2**24


def test_png_is_read(whole: Path, tmp_path: Path) -> None:
    folder = changed_meta(whole, tmp_path, lambda meta: meta["scales"].update(files=["scales.png"]))
    Image.open(folder / "scales.webp").save(folder / "scales.png")
    np.testing.assert_array_equal(read_sog(folder).scales, read_sog(whole / "files").scales)
