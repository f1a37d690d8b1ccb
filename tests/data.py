"""Data that some tests need: it is next to the checkout, and not on every machine; and damaged files."""

from pathlib import Path

import cv2
import numpy as np
import pytest

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared(name: str) -> Path:
    """The folder ../shared/data/NAME next to the checkout; skips the test where it is missing."""
    path = _SHARED / name
    if not path.is_dir():
        pytest.skip(f"the test data {path} is not on this machine")
    return path


def reduced(name: str, width: int, folder: Path, count: int | None = None) -> Path:
    """Makes `folder` a copy of the first images of ../shared/data/NAME, reduced: features take less time.

    Args: width, of the copies, in pixels; count, how many, by default all.
    """
    folder.mkdir(parents=True)
    for path in sorted((shared(name) / "images").iterdir())[:count]:
        picture = cv2.imread(str(path))
        assert picture is not None
        small = cv2.resize(picture, (width, width // 2), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / path.name), small, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return folder


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A file in which bits flip, and which is cut, or where some bytes are overwritten or repeated."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(changed)))
        match rng.integers(4):
            case 0:
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                del changed[at + 1 :]
            case 2:
                changed[at : at + int(rng.integers(9))] = rng.bytes(int(rng.integers(9)))
            case _:
                changed[at:at] = changed[at : at + int(rng.integers(40))]
        if not changed:
            break
    return bytes(changed)
