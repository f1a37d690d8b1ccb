"""Damaged files: an InputError that names the file, or a sound scene; never anything else."""

import random
import re
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from panolog.prepare.importers.import_scene import FORMATS, import_scene
from panolog.prepare.importers.interface import ImportedScene
from panolog.scene.colmap import read_colmap
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from tests.prepare.importers.writers import WRITERS

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


def _sound(parsed: ImportedScene) -> None:
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
                read_colmap(model)
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
            read_colmap(model)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
        tracemalloc.stop()
