"""Damaged files: an InputError that names the file, or a sound scene; never anything else."""

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.importers.import_scene import FORMATS
from panolog.prepare.importers.interface import ImportedScene
from panolog.scene.colmap import read_colmap
from panolog.scene.errors import InputError
from tests.data import mutated
from tests.prepare.importers.writers import WRITERS
from tests.scenes import write_scene

ROUNDS = 24  # of each file
NASTY = [b"null", b"-1", b"1e999", b"NaN", b"1e300", b"18446744073709551615", b'""', b"[]", b"{}", b"true"]
NASTY += [b'"../../x"', b"9" * 400]
VALUES = [re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?"), re.compile(rb'"[^"]*"')]


def _changed(data: bytes, turn: int, dice: np.random.Generator) -> bytes:
    """A number or a text replaced by a nasty one, or bytes changed."""
    found = list(VALUES[turn % 3].finditer(data)) if turn % 3 < 2 else []
    if not found:
        return mutated(data, dice)
    where = found[dice.integers(len(found))]
    return data[: where.start()] + NASTY[dice.integers(len(NASTY))] + data[where.end() :]


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
    dice = np.random.default_rng(list(case.encode()))
    for path in files:
        original = path.read_bytes()
        for turn in range(ROUNDS):
            path.write_bytes(_changed(original, turn, dice))
            try:
                _sound(FORMATS[kind].read(source))
            except InputError as error:
                assert str(tmp_path) in str(error)
                assert len(str(error)) < 600 and "\n" not in str(error)
        path.write_bytes(original)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_mutated_binaries(name: str, tmp_path: Path) -> None:
    """Of a COLMAP model; counts that are too large take no memory."""
    model, dice = write_scene(tmp_path) / "sparse" / "0", np.random.default_rng(1)
    data = (model / name).read_bytes()
    for _ in range(2 * ROUNDS):
        (model / name).write_bytes(mutated(data, dice))
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
