"""How far the camera has come in each frame of a video, in degrees of parallax, and how sharp it is."""

from collections import deque
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.video.parallax import WIDTH, Anchor, SphereBand

SHARP_WIDTH = 2048  # pixels at which sharpness is told: finer is the codec's noise
_BAND = 45.0  # degrees either side of the horizon where sharpness is told
_NEXT = 2.0  # degrees of parallax after which the next anchor takes over; noise is a tenth of a degree
_LEFT = 0.5  # of an anchor's corners, or it is replaced as well
_NOISE = 0.5  # degrees; what replaces an anchor for its lack of corners alone has not moved
_CLEAR = 0.5  # of the usual sharpness; what is less may not be an anchor, nor say that the scene has changed
_RECENT = 31  # frames that tell what is usual


@dataclass
class Piece:
    """Frames in which the motion could be followed throughout; three lists of the same length."""

    frames: list[int] = field(default_factory=list)  # ascending
    positions: list[float] = field(default_factory=list)  # degrees of parallax since the first
    sharpness: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class _Frame:
    number: int
    grey: NDArray[np.uint8]  # (WIDTH / 2, WIDTH)
    sharpness: float
    clear: bool


class MotionTracker:
    """Follows a camera through the frames of a video, to be given one after the other."""

    def __init__(self, width: int) -> None:
        """`width` is that of the frames, in pixels."""
        self.pieces: list[Piece] = []
        self._sphere = SphereBand(min(WIDTH, width // 2 * 2))
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._anchor: Anchor | None = None
        self._base = 0.0  # degrees, position of the anchor
        self._stray: _Frame | None = None

    def add(self, number: int, picture: NDArray[np.uint8]) -> None:
        """Places the next frame, (H, W, 3) BGR.

        One that cannot be placed is left out, as a flash is; two of them, both sharp, begin a new piece.
        """
        frame = self._frame(number, picture)
        if self._place(frame):
            self._stray = None
        elif frame.clear:
            if self._stray is not None:
                self._begin(self._stray)
            self._stray = None if self._stray is not None and self._place(frame) else frame

    def finish(self) -> list[Piece]:
        """All pieces, when no frame follows."""
        if self._stray is not None:
            self._begin(self._stray)
            self._stray = None
        return self.pieces

    def _frame(self, number: int, picture: NDArray[np.uint8]) -> _Frame:
        grey = _reduced(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8), SHARP_WIDTH)
        sharp = sharpness(grey)
        clear = not self._recent or sharp >= _CLEAR * float(np.median(self._recent))
        self._recent.append(sharp)
        return _Frame(number, _reduced(grey, self._sphere.width), sharp, clear)

    def _begin(self, frame: _Frame) -> None:
        """A new piece from `frame`, unless it shows nothing that could be followed."""
        anchor = Anchor(self._sphere, frame.grey)
        if anchor.usable:
            self._anchor, self._base = anchor, 0.0
            self.pieces.append(Piece([frame.number], [0.0], [_rounded(frame.sharpness)]))

    def _place(self, frame: _Frame) -> bool:
        """Adds `frame` to the present piece, if its motion can be told."""
        moved = None if self._anchor is None else self._anchor.measure(frame.grey)
        if moved is None:
            return False
        piece = self.pieces[-1]
        piece.frames.append(frame.number)
        piece.positions.append(round(self._base + moved.parallax, 3))
        piece.sharpness.append(_rounded(frame.sharpness))
        if frame.clear and (moved.parallax >= _NEXT or moved.tracked < _LEFT):
            anchor = Anchor(self._sphere, frame.grey)
            if anchor.usable:
                self._anchor = anchor
                self._base += moved.parallax if moved.parallax > _NOISE else 0.0
        return True


def sharpness(grey: NDArray[np.uint8]) -> float:
    """How fine the structure of a panorama (H, W) is around its horizon, whatever its exposure.

    The mean square of its Laplacian over the variance of its grey levels, rows weighted by their solid angle.
    """
    height = len(grey)
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * 180
    inside = np.flatnonzero(np.abs(latitude) < _BAND)
    band = grey[inside[0] : inside[-1] + 1]
    weights = np.cos(np.deg2rad(latitude[inside]))
    weights /= weights.sum()
    fine = cv2.Laplacian(band, cv2.CV_32F)
    # Sums over rows by OpenCV: a 2048 wide band takes 0.5 ms so, and nothing is copied to float64.
    squares = cv2.reduce(fine * fine, 1, cv2.REDUCE_AVG, dtype=cv2.CV_64F)[:, 0]
    means = cv2.reduce(band, 1, cv2.REDUCE_AVG, dtype=cv2.CV_64F)[:, 0]
    wide = band.astype(np.float32)
    second = cv2.reduce(wide * wide, 1, cv2.REDUCE_AVG, dtype=cv2.CV_64F)[:, 0]
    variance = float(weights @ second - (weights @ means) ** 2)
    return float(weights @ squares) / variance if variance > 1 else 0.0


def _reduced(grey: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """`grey` (H, W) at most `width` wide."""
    if grey.shape[1] <= width:
        return grey
    return np.asarray(cv2.resize(grey, (width, width // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
