"""Damaged files: an InputError that names the file, or a sound scene; never anything else."""

import random
import re
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.importers.import_scene import FORMATS
from panolog.prepare.importers.interface import ImportedScene
from panolog.scene.colmap import read_colmap
from panolog.scene.errors import InputError
from tests.prepare.importers.writers import WRITERS
from tests.scenes import write_scene

ROUNDS = 24  # of each file
NASTY = [b"null", b"-1", b"1e999", b"NaN", b"1e300", b"18446744073709551615", b'""', b"[]", b"{}", b"true"]
NASTY += [b'"../../x"', b"9" * 400]


def _swap(pattern: re.Pattern[bytes], data: bytes, dice: random.Random) -> bytes:
    where = dice.choice(list(pattern.finditer(data)) or [None])
    return data if where is None else data[: where.start()] + dice.choice(NASTY) + data[where.end() :]


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
    partial(_swap, re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")),
    partial(_swap, re.compile(rb'"[^"]*"')),
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
    dice = random.Random(case)
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


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_mutated_binaries(name: str, tmp_path: Path) -> None:
    """Of a COLMAP model; counts that are too large take no memory."""
    model, dice = write_scene(tmp_path) / "sparse" / "0", random.Random(1)
    data = (model / name).read_bytes()
    for turn in range(2 * ROUNDS):
        (model / name).write_bytes((_flip, _cut, _drop, _repeat)[turn % 4](data, dice))
        try:
            read_colmap(model)
        except InputError as error:
            assert str(model) in str(error)
    for count in (2**64 - 1, 2**63, 10**9):
        (model / name).write_bytes(count.to_bytes(8, "little") + data[8:])
        tracemalloc.start()
        with pytest.raises(InputError, match=re.escape(str(model / name))):
            read_colmap(model)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
        tracemalloc.stop()
