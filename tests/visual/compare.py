"""The reference pictures, and whether two pictures look the same: a shade of an edge does not count.

References are kept at half the size as WebP, and a picture is reduced in the same way before it is compared.
Both are blurred a little, and the mean difference of each tile of a grid is compared with a limit. A tile
that differs is compared again with its surroundings: it may have moved by a pixel or two, as text and lines
do when another version of the browser rounds differently.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]  # (H, W, 3)

TILE = 16  # pixels of reduced pictures, which have half the size
LIMIT = 8.0  # of 255: the mean difference of a tile, in the channel where it is largest
HEIGHT = 2  # pixels by which heights may differ
_QUALITY = 90  # of WebP: at 75 a change in one place alters the colours of others by more than LIMIT
_SIGMA = 1.6  # reduced pixels, of the blur
_MOVES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # reduced pixels, in each direction
_MARK = (60, 60, 255)  # BGR, of tiles that differ


@dataclass(frozen=True, eq=False)
class Comparison:
    """How a picture differs from its reference."""

    reason: str  # empty if it does not
    worst: float  # mean difference of the tile that differs most, of 255
    tiles: NDArray[np.bool_]  # (rows, columns) those that differ


def reduce(picture: Picture) -> bytes:
    """A picture as references are kept."""
    small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".webp", small, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1])


def expand(data: bytes) -> Picture:
    """The inverse of `reduce`, but for what is lost. Raises ValueError if it is no picture."""
    picture: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError("this is no picture")
    return np.asarray(picture, np.uint8)


def compare(reference: Picture, actual: Picture) -> Comparison:
    """Compares a picture with its reference, both reduced."""
    none = np.zeros((0, 0), np.bool_)
    (height, width), (rows, columns) = reference.shape[:2], actual.shape[:2]
    if width != columns:
        return Comparison(f"it is {columns} pixels wide, not {width}", 255.0, none)
    if abs(height - rows) > HEIGHT:
        return Comparison(f"it is {rows} pixels high, not {height}", 255.0, none)
    common = min(height, rows)
    worst = _tiles(reference[:common], actual[:common])
    tiles = worst > LIMIT
    if not tiles.any():
        return Comparison("", float(worst.max()), tiles)
    row, column = np.unravel_index(worst.argmax(), worst.shape)
    where = f"most at x {2 * column * TILE}, y {2 * row * TILE}, by {worst.max():.1f} of 255"
    return Comparison(f"{tiles.sum()} of {tiles.size} tiles differ, {where}", float(worst.max()), tiles)


def _tiles(reference: Picture, actual: Picture) -> NDArray[np.float32]:
    """(rows, columns) the difference of each tile from the nearest place in the reference where it may be."""
    first, second = (cv2.GaussianBlur(picture, (0, 0), _SIGMA) for picture in (reference, actual))
    worst = _means(first, second)
    if worst.max() > LIMIT:
        height, width = reference.shape[:2]
        for dy, dx in product(_MOVES, _MOVES):
            move = np.array([[1, 0, dx], [0, 1, dy]], np.float64)
            moved = cv2.warpAffine(first, move, (width, height), borderMode=cv2.BORDER_REPLICATE)
            worst = np.minimum(worst, _means(moved, second))
    return worst


def _means(first: Any, second: Any) -> NDArray[np.float32]:
    """(rows, columns) the mean of |first - second| in each tile, in the channel where it is largest."""
    difference = cv2.absdiff(first, second)
    height, width = difference.shape[:2]
    rows, columns = -(-height // TILE), -(-width // TILE)
    full = cv2.copyMakeBorder(
        difference, 0, rows * TILE - height, 0, columns * TILE - width, cv2.BORDER_CONSTANT, value=(0, 0, 0)
    )
    means = full.reshape(rows, TILE, columns, TILE, 3).mean(axis=(1, 3), dtype=np.float32)
    return np.asarray(means.max(axis=2), np.float32)


def side_by_side(reference: Picture, actual: Picture, comparison: Comparison) -> Picture:
    """The reference, the picture, and the picture with the tiles marked that differ."""
    marked = actual.copy()
    for row, column in np.argwhere(comparison.tiles):
        corner = (int(column) * TILE, int(row) * TILE)
        cv2.rectangle(marked, corner, (corner[0] + TILE - 1, corner[1] + TILE - 1), _MARK, 2)
    height = max(len(reference), len(actual))
    parts = [
        cv2.copyMakeBorder(part, 0, height - len(part), 0, 12, cv2.BORDER_CONSTANT, value=(128, 128, 128))
        for part in (reference, actual, marked)
    ]
    return np.concatenate(parts, axis=1)


FOLDER = Path(__file__).with_name("references")


def path_of(name: str) -> Path:
    """Where a reference is."""
    return FOLDER / f"{name}.webp"


def write(name: str, picture: Picture) -> None:
    """Writes a reference."""
    FOLDER.mkdir(exist_ok=True)
    path_of(name).write_bytes(reduce(picture))


def difference(name: str, picture: Picture, folder: Path) -> str:
    """How a picture differs from its reference, and where both are shown; empty if it does not.

    Args: folder, for that picture.
    """
    renew = f"`python -m tests.visual {name}` makes it anew"
    if not path_of(name).is_file():
        return f"there is no {path_of(name)}: {renew}"
    reference, reduced = expand(path_of(name).read_bytes()), expand(reduce(picture))
    comparison = compare(reference, reduced)
    if not comparison.reason:
        return ""
    both = folder / f"{name}.png"
    cv2.imwrite(str(both), side_by_side(reference, reduced, comparison))
    return f"{comparison.reason}: see {both}; if it is meant to look so, {renew}"
