"""Data that some tests need: it is next to the checkout, and not on every machine."""

from pathlib import Path

import cv2
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
