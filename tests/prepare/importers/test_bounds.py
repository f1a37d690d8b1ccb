"""Hostile files: what they promise takes no memory, and what they hold is bounded."""

import re
import tracemalloc
from pathlib import Path

import pytest

from panolog.prepare.importers.json_xml import load_json, load_xml
from panolog.prepare.importers.point_cloud import read_point_cloud
from panolog.scene import colmap_files
from panolog.scene.colmap import read_colmap
from panolog.scene.errors import InputError
from tests.prepare.importers.writers import WRITERS


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", ["99999999999999999999", "10000000000", "-1", "1e9", "x", ""])
def test_huge_counts_in_ply(layout: str, count: str, tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {layout} 1.0\nelement vertex {count}\n{axes}end_header\n"
    path.write_bytes(head.encode() + b"1 2 3\n" * 20)
    tracemalloc.start()
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_point_cloud(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_endless_ply_header(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\n" + b"comment x\n" * 100_000)
    with pytest.raises(InputError, match="header"):
        read_point_cloud(path)


@pytest.mark.parametrize(
    "text",
    [
        "[" + "[]," * 20_000 + "[]]",
        "[" + "{}," * 20_000 + "{}]",
        '[{"a":1}' + ',{"a":1}' * 20_000 + "]",
        "[" + "1.5," * 20_000 + "1.5]",
        "[" + '"a",' * 20_000 + '"b"]',
        '{"' + '":0,"'.join(map(str, range(20_000))) + '":0}',
        "[" + '"é€𝄞"' * 1 + ',"é€𝄞"' * 20_000 + "]",
        "<a>" + "<b/>" * 20_000 + "</a>",
        "<a>" + "<b c='1'/>" * 20_000 + "</a>",
        "<a>" + "<b>x</b>y" * 20_000 + "</a>",
        "<a>" * 20_000 + "</a>" * 20_000,
    ],
)
def test_what_needs_more_than_the_memory_is_refused(text: str, tmp_path: Path) -> None:
    """The estimate of what a file needs is an upper bound, but for a tenth."""
    load = load_xml if text.startswith("<") else load_json
    path = tmp_path / "cameras"
    path.write_text(text, encoding="utf-8")
    tracemalloc.start()
    content = load(path)
    needed = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert content is not None
    with pytest.raises(InputError, match="cameras: too large"):
        load(path, needed * 9 // 10)


@pytest.mark.system
@pytest.mark.parametrize("name", ["images.txt", "points3D.txt", "cameras.txt"])
def test_text_models_take_little_more_than_they_are_large(name: str, tmp_path: Path) -> None:
    """Seven bytes for each byte of text are 0.9 GB for the longest file that is read."""
    _, source = WRITERS["spheresfm"][1](tmp_path / "source")
    path = source.path / "sparse" / "0" / name
    line = {"images.txt": "1 1 0 0 0 0 0 0 0 a\n" + "1 1 1 " * 500 + "\n", "points3D.txt": "1 1 1 1 1 1 1\n"}
    path.write_text(line.get(name, "1 SPHERE 2 1 1 1 .5\n") * (500_000 // len(line.get(name, " " * 20))))
    tracemalloc.start()
    try:
        read_colmap(path.parent)
    except InputError as error:
        assert str(path.parent) in str(error)
    assert tracemalloc.get_traced_memory()[1] < 7 * path.stat().st_size + 250_000
    tracemalloc.stop()


def test_a_line_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colmap_files, "_LONGEST_LINE", 10_000)
    _, source = WRITERS["spheresfm"][1](tmp_path / "source")
    path = source.path / "sparse" / "0" / "images.txt"
    path.write_text("1 1 0 0 0 0 0 0 0 a\n" + "1 1 1 " * 5000)
    with pytest.raises(InputError, match=r"images\.txt: line 2 is not terminated"):
        read_colmap(path.parent)
    monkeypatch.setattr(colmap_files, "_LONGEST_TEXT", 10_000)
    with pytest.raises(InputError, match=r"images\.txt: too large"):
        read_colmap(path.parent)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000,
        "<a>" * 200_000,
        '<!DOCTYPE a [<!ENTITY b "cccccccccc"><!ENTITY d "&b;&b;&b;&b;&b;&b;&b;&b;">]><a>&b;</a>',
        '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]><a>&b;</a>',
        '<!DOCTYPE a SYSTEM "http://localhost/x.dtd"><a>&b;</a>',
    ],
)
def test_deep_nesting_entities_and_document_types(text: str, tmp_path: Path) -> None:
    is_xml, path = text.startswith("<"), tmp_path / "cameras"
    path.write_text(text)
    with pytest.raises(InputError, match=f"cameras: is not {'plain XML' if is_xml else 'JSON'}"):
        (load_xml if is_xml else load_json)(path)
