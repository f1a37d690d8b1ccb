"""How the decoded pictures of a video become panoramas: turned, one eye, and placed on the whole sphere."""

import struct
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.video.spherical import Spherical, Stereo
from panolog.scene.image_files import resize
from panolog.scene.pictures.kinds import EXPORT, STITCH

Turn = tuple[int, int, int, int]  # (a, b, c, d): x' = a x + c y, y' = b x + d y, each -1, 0 or 1

Pixel = TypeVar("Pixel", np.uint8, np.uint16)

_UPRIGHT = (1, 0, 0, 1)
_NEARLY = 0.01  # of its width: how far a whole panorama may be from 2:1
_LEFT_EYE: dict[Stereo, tuple[float, float, float, float]] = {  # of the picture: left, top, right, bottom
    "mono": (0.0, 0.0, 1.0, 1.0),
    "top-bottom": (0.0, 0.0, 1.0, 0.5),
    "left-right": (0.0, 0.0, 0.5, 1.0),
    "right-left": (0.5, 0.0, 1.0, 1.0),
}


class LayoutError(ValueError):
    """Why pictures are no panoramas, and what to do."""


class Span(NamedTuple):
    """A rectangle of pixels."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows and columns."""
        return self.bottom - self.top, self.right - self.left

    @property
    def slices(self) -> tuple[slice, slice]:
        """The rows and columns, to index an array with."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


@dataclass(frozen=True)
class Layout:
    """Where the pixels of a decoded picture are in the panorama."""

    turn: Turn  # from the decoded to the displayed picture
    eye: Span  # of the displayed picture
    place: Span  # of the panorama, which the eye fills
    width: int  # pixels of the panorama; its height is half of it

    @property
    def is_whole(self) -> bool:
        """Whether the picture covers the whole sphere."""
        return self.place.shape == (self.width // 2, self.width)

    def scaled(self, width: int) -> "Layout":
        """The layout of panoramas that are at most `width` pixels wide."""
        if width >= self.width:
            return self
        place = Span(*(round(edge * width / self.width) for edge in self.place))
        return replace(self, place=place, width=width)

    def panorama(self, picture: NDArray[Pixel]) -> NDArray[Pixel]:
        """(width / 2, width, ...) of a decoded picture (H, W, ...); 0 where there is none."""
        eye = _displayed(picture, self.turn)[self.eye.slices]
        rows, columns = self.place.shape
        height, width = eye.shape[:2]
        if height >= 2 * rows and width >= 2 * columns and not (height % 2 or width % 2):
            eye = resize(eye, (width // 2, height // 2))  # ten times as fast as by another factor
        if eye.shape[:2] != (rows, columns):
            eye = resize(eye, (columns, rows))
        if self.is_whole:
            return np.ascontiguousarray(eye)
        whole = np.zeros((self.width // 2, self.width, *picture.shape[2:]), picture.dtype)
        whole[self.place.slices] = eye
        return whole

    def mask(self) -> NDArray[np.uint8]:
        """(width / 2, width) 255 where the picture covers the panorama, 0 elsewhere."""
        covered = np.zeros((self.width // 2, self.width), np.uint8)
        covered[self.place.slices] = 255
        return covered


def whole_width(width: float, height: float, *, columns: int = 0) -> int | None:
    """The width, in pixels, of the panorama that a whole picture of nearly 2:1 is stretched to; else None.

    Programs that scale or encode pictures leave out rows, so that of 2048 x 1024 there are 2048 x 1023.

    Args: width, height, as it is shown; columns, that it has at least, if its pixels are not square.
    """
    return 2 * round(max(width, columns) / 2) if abs(width - 2 * height) <= _NEARLY * width else None


def layout_of(
    width: int,
    height: int,
    matrix: bytes | None,
    spherical: Spherical | None,
    widest: int,
    aspect: float,
) -> Layout:
    """The layout of a video's pictures.

    Args:
        width, height: of the decoded pictures, in pixels.
        matrix: the display matrix, as FFmpeg gives it: nine native integers, row by row, 16.16.
        widest: the maximum width of a panorama, in pixels.
        aspect: the width of a pixel by its height, as players show it; it counts if pictures are not 2:1.

    Raises LayoutError: the pictures are no panoramas, or too large.
    """
    turn = _turn(matrix, width, height)
    if turn[0] == 0:
        width, height, aspect = height, width, 1 / aspect
    if spherical is None:
        panorama = whole_width(width, height) or whole_width(aspect * width, height, columns=width)
        if panorama is None:
            raise LayoutError(f"its frames of {width} x {height} pixels are not 2:1; {STITCH}")
        return Layout(turn, Span(0, height, 0, width), Span(0, panorama // 2, 0, panorama), panorama)
    if spherical.projection != "equirectangular":
        raise LayoutError(f"its projection is {spherical.projection}, not equirectangular; {EXPORT}")
    if spherical.stereo not in _LEFT_EYE:
        raise LayoutError(f"how it stores its two eyes is not known ({spherical.stereo}); {EXPORT}")
    left, top, right, bottom = _LEFT_EYE[spherical.stereo]
    eye = Span(round(top * height), round(bottom * height), round(left * width), round(right * width))
    return _placed(turn, eye, spherical, widest)


def _placed(turn: Turn, eye: Span, spherical: Spherical, widest: int) -> Layout:
    """The layout of an eye that covers the panorama but for its bounds. Raises LayoutError."""
    left, top, right, bottom = spherical.bounds
    rows, columns = eye.shape
    across = 1 - left - right
    if rows > 0 and 0 < columns <= across * widest:
        width = 2 * round(columns / across / 2)
        height = width // 2
        edges = (top * height, (1 - bottom) * height, left * width, (1 - right) * width)
        place = Span(*(round(edge) for edge in edges))
        if min(place.shape) > 0:
            return Layout(turn, eye, place, width)
    raise LayoutError(f"its frames cover too little of the panorama that its header describes; {EXPORT}")


def _turn(matrix: bytes | None, width: int, height: int) -> Turn:
    """How the display matrix turns or mirrors pictures, unless that leaves one upright: no panorama is."""
    if matrix is None or len(matrix) != 36:
        return _UPRIGHT
    a, b, _, c, d, *_ = struct.unpack("=9i", matrix)
    a, b, c, d = (round(value / 2**16) for value in (a, b, c, d))
    straight = abs(a) == abs(d) == 1 and b == c == 0
    quarter = abs(b) == abs(c) == 1 and a == d == 0 and height > width
    return (a, b, c, d) if straight or quarter else _UPRIGHT


def _displayed(picture: NDArray[Pixel], turn: Turn) -> NDArray[Pixel]:
    """The picture (H, W, ...) turned."""
    a, b, c, d = turn
    if a == 0:
        picture, a, d = picture.swapaxes(0, 1), c, b
    return picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
