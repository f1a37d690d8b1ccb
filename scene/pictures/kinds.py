"""Pictures that are no panoramas: fisheye circles that were not stitched, and stereo pictures."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import SceneError

EXPORT = "export it as equirectangular 2:1 (mono)"
STITCH_THERE = (
    f"stitch it in the camera's program, such as Insta360 Studio, RICOH THETA or GoPro Player, and {EXPORT}"
)
STITCH = f"{STITCH_THERE}, or with `panolog scene stitch SOURCE -o FOLDER`"

_MAGIC = {  # at the beginning of a file, or behind the length of its first box
    b"ftyphei": "HEIC",
    b"ftypmif1": "HEIC",
    b"ftypavif": "AVIF",
    b"JXL ": "JPEG XL",
    b"\xff\x0a": "JPEG XL",
    b"PK\3\4": "an archive",
}
_BAND = (0.72, 0.85)  # rows that are looked at, of the half height of a square, from its middle
_CORNER = 0.85  # of its half width, from which on columns of these rows are outside of any circle
_MIDDLE = 0.3  # and up to which they are within a circle of at least 0.9 of the square
_DARK, _BRIGHT = 20, 40  # of 255: what is outside of a circle, but for stray light, and the mean within it
_OUTSIDE = 95  # percent of what is outside of it that is dark
_SIDE = 32  # pixels of the pictures of two eyes that are compared
_COARSE = 9  # of these pixels: what is larger, such as light and dark sides, is left out
_ALIKE = 0.8  # correlation of two eyes, at least; front and back: 0.27 in photographs, 0.76 of equal houses
_PLAIN = 12.0  # standard deviation of details, at least: those photographs have 20 or more


def describe_picture(grey: NDArray[np.uint8]) -> str | None:
    """What a picture (H, W) shows and what to do, if it is no panorama but circles or two eyes; else None.

    Fisheye circles fill squares, one, or two next to or above each other, and are dark around. Near the top
    and the bottom of a panorama all columns are similar: there it shows the poles. The eyes of a stereo
    picture are nearly alike, side by side (VR180) or one above the other (360°), front and back are not.
    """
    height, width = grey.shape
    halves: list[NDArray[np.uint8]]
    if abs(width - 2 * height) <= 2 or abs(height - 2 * width) <= 2:
        halves = np.array_split(grey, 2, axis=int(width > height))
        if all(map(_is_circle, halves)):
            return f"two fisheye circles; {STITCH}"
        if width > height and _are_eyes(*halves):
            return "two eyes side by side (VR180), half of the sphere; a panorama shows all of it"
    elif abs(width - height) <= 2:
        if _is_circle(grey):
            return f"one fisheye circle; {STITCH}, with that of the other lens"
        if _are_eyes(*np.array_split(grey, 2)):
            return f"two eyes, one above the other; {EXPORT}, or cut off the lower half"
    return None


def kind_of(data: bytes) -> str | None:
    """The format of a file that is not read, by its first bytes; None if it is none of these."""
    return next((kind for magic, kind in _MAGIC.items() if data[:16].find(magic) in (0, 4)), None)


def require_panorama(path: Path, grey: NDArray[np.uint8]) -> None:
    """Raises SceneError if a picture (H, W), the file at `path`, is no panorama: see `describe_picture`."""
    if (what := describe_picture(grey)) is not None:
        raise SceneError(f"{path}: is no panorama, but shows {what}")


def _is_circle(square: NDArray[np.uint8]) -> bool:
    """Whether a picture (S, S) shows a circle, dark around and bright within."""
    down, across = (np.abs((np.arange(size) + 0.5) / size * 2 - 1) for size in square.shape)
    rows = square[(down > _BAND[0]) & (down < _BAND[1])]
    outside, within = rows[:, across > _CORNER], rows[:, across < _MIDDLE]
    if not outside.size or not within.size:
        return False
    return bool(np.percentile(outside, _OUTSIDE) < _DARK and within.mean() > _BRIGHT)


def _are_eyes(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Whether two pictures (H, W) show the same details."""
    a, b = map(_differences, (one, other))
    spread = float(np.sqrt((a * a).mean() * (b * b).mean()))
    return spread > _PLAIN**2 and float((a * b).mean()) > _ALIKE * spread


def _differences(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(32, 32) the details of a picture (H, W), without what a row has in common."""
    small: NDArray[Any] = cv2.resize(picture, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    details = small - cv2.blur(small, (_COARSE, _COARSE))
    return np.asarray(details - details.mean(axis=1, keepdims=True), np.float32)
