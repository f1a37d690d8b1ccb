"""Damaged and hostile files: an InputError that names the file, or a sound scene; never anything else."""

import json
import random
import re
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from panolog.scene.errors import InputError
from panolog.scene.importers import raw_text, sources
from panolog.scene.importers.cloud import read_points
from panolog.scene.importers.parsed import Parsed, Source
from panolog.scene.importers.raw_colmap import read_raw
from panolog.scene.importers.registry import FORMATS
from panolog.scene.importers.write import import_scene
from panolog.scene.read import read_scene
from tests.scene.importers.writers import WRITERS, nerfstudio, openmvg, openmvg_parts, write_json

ROUNDS = 24  # of each file
NASTY = [
    "null",
    "-1",
    "1e999",
    "NaN",
    "1e300",
    "18446744073709551615",
    '""',
    "[]",
    "{}",
    "true",
    '"../../x"',
    "9" * 400,
]
_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")


def _swap_number(data: bytes, dice: random.Random) -> bytes:
    found = list(_NUMBER.finditer(data))
    where = dice.choice(found) if found else None
    return (
        data if where is None else data[: where.start()] + dice.choice(NASTY).encode() + data[where.end() :]
    )


def _swap_text(data: bytes, dice: random.Random) -> bytes:
    found = list(re.finditer(rb'"[^"]*"', data))
    where = dice.choice(found) if found else None
    return (
        data if where is None else data[: where.start()] + dice.choice(NASTY).encode() + data[where.end() :]
    )


def _flip(data: bytes, dice: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        changed[dice.randrange(len(changed))] = dice.randrange(256)
    return bytes(changed)


def _cut(data: bytes, dice: random.Random) -> bytes:
    return data[: dice.randrange(len(data))]


def _drop(data: bytes, dice: random.Random) -> bytes:
    start = dice.randrange(len(data))
    return data[:start] + data[start + dice.randint(1, 200) :]


def _repeat(data: bytes, dice: random.Random) -> bytes:
    start = dice.randrange(len(data))
    return data[:start] + data[start : start + 300] * 2 + data[start + 300 :]


MUTATIONS: list[Callable[[bytes, random.Random], bytes]] = [
    _swap_number,
    _swap_text,
    _flip,
    _cut,
    _drop,
    _repeat,
]


def _sound(parsed: Parsed) -> None:
    """What every reader promises."""
    for image in parsed.images:
        assert np.abs(image.rotation @ image.rotation.T - np.eye(3)).max() < 1e-6
        assert np.linalg.det(image.rotation) > 0
        assert np.isfinite(image.translation).all()
        rows, fractions = image.sightings
        assert len(rows) == len(fractions) and np.isfinite(fractions).all()
        assert not len(rows) or 0 <= rows.min() <= rows.max() < len(parsed.points)
        assert image.file.is_file() and ".." not in image.name
    assert np.isfinite(parsed.points).all()


@pytest.mark.parametrize("case", WRITERS)
def test_mutated_files(case: str, tmp_path: Path) -> None:
    kind, writer = WRITERS[case]
    _, source = writer(tmp_path / "source")
    files = [
        path
        for path in sorted((tmp_path / "source").rglob("*"))
        if path.suffix in (".json", ".xml", ".csv", ".txt", ".ply")
    ]
    dice, began = random.Random(case), time.monotonic()
    for path in files:
        original = path.read_bytes()
        for turn in range(ROUNDS):
            path.write_bytes(MUTATIONS[turn % len(MUTATIONS)](original, dice))
            try:
                _sound(FORMATS[kind].read(source))
            except InputError as error:
                assert str(tmp_path) in str(error)
                assert len(str(error)) < 600 and "\n" not in str(error)
        path.write_bytes(original)
    assert time.monotonic() - began < 60


@pytest.mark.parametrize("case", ["opensfm", "spheresfm", "nerfstudio"])
def test_mutated_to_the_end(case: str, tmp_path: Path) -> None:
    """An import that fails leaves nothing; one that does not is a scene that can be read."""
    _, writer = WRITERS[case]
    _, source = writer(tmp_path / "source")
    path = next(iter([*(tmp_path / "source").rglob("*.json"), *(tmp_path / "source").rglob("images.txt")]))
    original, dice = path.read_bytes(), random.Random(case)
    for turn in range(24):
        path.write_bytes(MUTATIONS[turn % len(MUTATIONS)](original, dice))
        output = tmp_path / f"scene{turn}"
        try:
            import_scene(source, output, format=WRITERS[case][0])
            read_scene(output)
        except InputError:
            assert not output.exists()
        assert not list(tmp_path.glob(".scene*"))


def _binary_model(folder: Path) -> Path:
    """A COLMAP binary model with SPHERE cameras, from what the text importer reads."""
    _, source = WRITERS["nerfstudio"][1](folder / "source")
    import_scene(source, folder / "scene")
    model = folder / "scene" / "sparse" / "0"
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    return model


def test_mutated_binaries(tmp_path: Path) -> None:
    model, dice = _binary_model(tmp_path), random.Random(1)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        original = (model / name).read_bytes()
        for turn in range(2 * ROUNDS):
            (model / name).write_bytes((_flip, _cut, _drop, _repeat)[turn % 4](original, dice))
            try:
                read_raw(model)
            except InputError as error:
                assert str(model) in str(error)
        (model / name).write_bytes(original)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_huge_counts_in_binaries(name: str, tmp_path: Path) -> None:
    model = _binary_model(tmp_path)
    data = (model / name).read_bytes()
    for count in (2**64 - 1, 2**63, 10**9):
        (model / name).write_bytes(count.to_bytes(8, "little") + data[8:])
        tracemalloc.start()
        with pytest.raises(InputError, match=re.escape(str(model / name))):
            read_raw(model)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
        tracemalloc.stop()


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", ["99999999999999999999", "10000000000", "-1", "1e9", "x", ""])
def test_huge_counts_in_ply(layout: str, count: str, tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    lines = [
        "ply",
        f"format {layout} 1.0",
        f"element vertex {count}",
        *(f"property float {axis}" for axis in "xyz"),
    ]
    head = "\n".join([*lines, ""])
    path.write_bytes(head.encode() + b"end_header\n" + b"1 2 3\n" * 20)
    tracemalloc.start()
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_points(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_endless_ply_header(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\n" + b"comment x\n" * 100_000)
    with pytest.raises(InputError, match="header"):
        read_points(path)


@pytest.mark.parametrize(
    "text",
    [
        "[" + "[]," * 50_000 + "[]]",
        "[" + "{}," * 50_000 + "{}]",
        '[{"a":1}' + ',{"a":1}' * 50_000 + "]",
        "[" + "1.5," * 50_000 + "1.5]",
        "[" + '"a",' * 50_000 + '"b"]',
        '{"' + '":0,"'.join(map(str, range(50_000))) + '":0}',
        "[" + '"é€𝄞"' * 1 + ',"é€𝄞"' * 50_000 + "]",
    ],
)
def test_the_estimate_of_json_is_an_upper_bound(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(text, encoding="utf-8")
    data = path.read_bytes()
    estimate = sources._estimate(data, sources._JSON_COST)
    tracemalloc.start()
    value = json.loads(data)
    assert value is not None
    assert tracemalloc.get_traced_memory()[1] < estimate + 100_000
    tracemalloc.stop()


def test_too_large_json_and_xml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "MEMORY", 1_000_000)
    (tmp_path / "x.json").write_text("[" + "[]," * 10_000 + "[]]")
    with pytest.raises(InputError, match=r"x\.json: too large"):
        sources.load_json(tmp_path / "x.json")
    (tmp_path / "x.xml").write_text("<a>" + "<b/>" * 10_000 + "</a>")
    with pytest.raises(InputError, match=r"x\.xml: too large"):
        sources.load_xml(tmp_path / "x.xml")


@pytest.mark.parametrize(
    "text",
    [
        "<a>" + "<b/>" * 50_000 + "</a>",
        "<a>" + "<b c='1'/>" * 50_000 + "</a>",
        "<a>" + "<b>x</b>y" * 50_000 + "</a>",
        "<a>" * 50_000 + "</a>" * 50_000,
    ],
)
def test_the_estimate_of_xml_is_an_upper_bound(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.xml"
    path.write_text(text)
    tracemalloc.start()
    root = sources.load_xml(path)
    assert tracemalloc.get_traced_memory()[1] < sources._estimate(text.encode(), sources._XML_COST) + 500_000
    tracemalloc.stop()
    assert root.tag == "a"


@pytest.mark.parametrize("name", ["images.txt", "points3D.txt", "cameras.txt"])
def test_text_models_take_little_more_than_they_are_large(name: str, tmp_path: Path) -> None:
    """Seven bytes for each byte of text are 0.9 GB for the longest file that is read."""
    _, source = WRITERS["spheresfm"][1](tmp_path / "source")
    path = source.path / "sparse" / "0" / name
    line = {"images.txt": "1 1 0 0 0 0 0 0 0 a\n" + "1 1 1 " * 500 + "\n", "points3D.txt": "1 1 1 1 1 1 1\n"}
    path.write_text(line.get(name, "1 SPHERE 2 1 1 1 .5\n") * (2_000_000 // len(line.get(name, " " * 20))))
    tracemalloc.start()
    try:
        read_raw(path.parent)
    except InputError as error:
        assert str(path.parent) in str(error)
    assert tracemalloc.get_traced_memory()[1] < 7 * path.stat().st_size + 1_000_000
    tracemalloc.stop()


def test_a_line_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raw_text, "_LONGEST_LINE", 10_000)
    _, source = WRITERS["spheresfm"][1](tmp_path / "source")
    path = source.path / "sparse" / "0" / "images.txt"
    path.write_text("1 1 0 0 0 0 0 0 0 a\n" + "1 1 1 " * 5000)
    with pytest.raises(InputError, match=r"images\.txt: line 2 has no end"):
        read_raw(path.parent)
    monkeypatch.setattr(raw_text, "_LONGEST_TEXT", 10_000)
    with pytest.raises(InputError, match=r"images\.txt: too large"):
        read_raw(path.parent)


def test_deep_nesting(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("[" * 200_000)
    with pytest.raises(InputError, match=r"x\.json: is no JSON"):
        sources.load_json(tmp_path / "x.json")
    (tmp_path / "x.xml").write_text("<a>" * 200_000)
    with pytest.raises(InputError, match=r"x\.xml: is no plain XML"):
        sources.load_xml(tmp_path / "x.xml")


@pytest.mark.parametrize(
    "head",
    [
        '<!DOCTYPE a [<!ENTITY b "cccccccccc"><!ENTITY d "&b;&b;&b;&b;&b;&b;&b;&b;">]>',
        '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE a SYSTEM "http://localhost/x.dtd">',
    ],
)
def test_entities_and_document_types(head: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text(f"{head}<document><chunk>&b;</chunk></document>")
    with pytest.raises(InputError, match=r"cameras\.xml: is no plain XML"):
        sources.load_xml(path)


@pytest.mark.parametrize("name", ["../secret.png", "/../x", "a\0b", "x" * 2000, "", ".."])
def test_names_that_leave_the_folder(name: str, tmp_path: Path) -> None:
    known, source = openmvg(tmp_path / "source")
    parts = openmvg_parts(known)
    parts["views"][3]["value"]["ptr_wrapper"]["data"]["filename"] = name
    write_json(tmp_path / "source" / "sfm_data.json", parts)
    with pytest.raises(InputError, match=r"sfm_data\.json: views\[3\]\.value\.ptr_wrapper\.data\.filename"):
        FORMATS["openmvg"].read(source)


def test_errors_name_file_and_field(tmp_path: Path) -> None:
    known, source = openmvg(tmp_path / "source")
    path = tmp_path / "source" / "sfm_data.json"
    changes: list[tuple[Callable[[Any], Any], str]] = [
        (lambda p: p["extrinsics"][2]["value"]["center"].pop(), r"extrinsics\[2\]\.value\.center: 3 finite"),
        (lambda p: p["extrinsics"][2]["value"].pop("rotation"), r"extrinsics\[2\]\.value: has no 'rotation'"),
        (
            lambda p: p["extrinsics"][1]["value"]["rotation"][0].reverse(),
            r"extrinsics\[1\]\.value\.rotation: ",
        ),
        (lambda p: p.pop("views"), r"sfm_data\.json: has no 'views'"),
        (
            lambda p: p["intrinsics"][0]["value"].update(polymorphic_name="pinhole"),
            "its intrinsic is pinhole",
        ),
        (lambda p: p["views"][0]["value"]["ptr_wrapper"]["data"].update(width=100), r"views\[0\].*not 2:1"),
        (lambda p: p["structure"][5]["value"].update(X=[1, 2, "y"]), r"structure\[5\]\.value\.X: 3 "),
    ]
    for change, words in changes:
        parts = openmvg_parts(known)
        change(parts)
        write_json(path, parts)
        with pytest.raises(InputError, match=words):
            FORMATS["openmvg"].read(source)


def test_a_mirror_is_no_pose(tmp_path: Path) -> None:
    known, source = nerfstudio(tmp_path / "source")
    path = tmp_path / "source" / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[0] *= -1
    write_json(path, content)
    with pytest.raises(InputError, match=r"frames\[0\]\.transform_matrix: mirrors"):
        FORMATS["nerfstudio"].read(source)
    assert known.width == 64


def test_wrong_sources(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    for wrong, option, words in (
        (Source(tmp_path / "nowhere"), None, "there is no such file or folder"),
        (Source(tmp_path), None, "of no format that can be imported; say which with --format"),
        (source, "colmapper", "--format colmapper: there is no such format; one of openmvg"),
        (Source(source.path, images=tmp_path / "none"), None, "--images .*none: there is no such"),
        (Source(source.path, points=tmp_path / "none.ply"), None, "--points .*none.ply: there is no such"),
        (Source(source.path, images=tmp_path), None, "pano_00.png is not in .*; say where the panoramas are"),
    ):
        with pytest.raises(InputError, match=words):
            import_scene(wrong, tmp_path / "scene", format=option)
    with pytest.raises(InputError, match="is there already; give a new folder"):
        import_scene(source, tmp_path / "source")
    assert not (tmp_path / "scene").exists()


def test_interrupted(tmp_path: Path) -> None:
    """Ctrl-C while images are copied leaves nothing behind."""

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    _, source = nerfstudio(tmp_path / "source")
    with pytest.raises(KeyboardInterrupt):
        import_scene(source, tmp_path / "scene", progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]
