"""The text form of a COLMAP model (doc/format.rst of COLMAP), line by line."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from panolog.prepare.importers.raw_records import MODELS, NO_POINT, Entry, Points, camera
from panolog.scene.colmap_check import RawCamera
from panolog.scene.errors import SceneError

_PARAMETERS = dict(MODELS.values())
_LONGEST_LINE = 2**24  # characters: half a million observations of one image; 0.8 GB while it is taken apart
_LONGEST_TEXT = 2**27  # bytes of a text file


def cameras(path: Path) -> Iterator[RawCamera]:
    for number, line in _lines(path):
        words = line.split()
        if not line or line.startswith("#"):
            continue
        numbers = _numbers(path, number, [words[0], *words[2:]], 3)
        if len(words) < 2 or _PARAMETERS.get(words[1]) != len(numbers) - 3:
            raise SceneError(f"{path}: line {number}: `{line[:60]}` is neither a panorama nor a pinhole")
        size = (int(numbers[1]), int(numbers[2]))
        yield camera(path, int(numbers[0]), words[1], size, tuple(numbers[3:]))


def images(path: Path) -> Iterator[Entry]:
    """Every image has two lines: its pose, then its points, which may be empty."""
    lines = _lines(path)
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        words = line.split(None, 9)
        if len(words) < 10:
            raise SceneError(f"{path}: line {number}: `{line[:60]}` is no image; export the model again")
        pose = _numbers(path, number, words[1:8], 7)
        owner = _numbers(path, number, words[8:9], 1)
        below, second = next(lines, (number, ""))
        values = np.array(_numbers(path, below, second.split(), 0))
        if len(values) % 3:
            raise SceneError(f"{path}: line {below}: the points of {words[9][:60]} are no triples")
        seen = values.reshape(-1, 3)
        ids = np.where((seen[:, 2] >= 0) & (seen[:, 2] < 2**53), seen[:, 2], 2**53).astype(np.uint64)
        ids[ids == 2**53] = NO_POINT
        yield words[9], int(owner[0]), tuple(pose), seen[:, :2], ids


def points(path: Path) -> Points:
    found = Points()
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        values = _numbers(path, number, line.split(None, 8)[:7], 7)
        if not all(0 <= value < 256 for value in values[4:]) or not 0 <= values[0] < 2**53:
            raise SceneError(f"{path}: line {number}: `{line[:60]}` is no point; export the model again")
        found.add(int(values[0]), values[1:4], map(int, values[4:]))
    return found


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, line) of a text file, without line ends."""
    if not path.is_file():
        raise SceneError(f"{path}: the COLMAP model has no such file; export it again")
    if path.stat().st_size > _LONGEST_TEXT:
        raise SceneError(f"{path}: too large to be read safely as text; convert the model to binary")
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), start=1):
            if len(line) == _LONGEST_LINE:
                raise SceneError(f"{path}: line {number} has no end; export the model again")
            yield number, line.strip()


def _numbers(path: Path, line: int, words: list[str], least: int) -> list[float]:
    """Finite numbers, at least `least` of them."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) < least or not all(map(math.isfinite, numbers)):
        raise SceneError(f"{path}: line {line}: finite numbers were expected; export the model again")
    return numbers
