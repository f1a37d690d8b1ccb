"""How far the camera has moved in each frame of a video, in degrees of parallax, and how sharp it is.

The result is kept as JSON next to the frames, because the search takes long.
"""

import json
from collections import deque
from copy import copy
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, TypeAdapter

from panolog.prepare.video.decode import MAX_FRAMES
from panolog.prepare.video.parallax import WIDTH, Anchor, Displacement, SphereBand
from panolog.scene.files import write_bytes
from panolog.scene.image_files import resize

SHARP_WIDTH = 2048  # pixels at which sharpness is measured: finer structure is noise of the codec
_BAND = 45.0  # degrees on either side of the horizon where sharpness is measured
_NEXT = 2.0  # degrees of parallax after which the anchor is replaced; noise is a tenth of a degree
_LEFT = 0.5  # of an anchor's corners, or it is replaced as well
_NOISE = 0.5  # degrees; below, an anchor that is replaced for lack of corners has not moved
_CLEAR = 0.5  # of the recent sharpness; a frame below is no anchor, and no sign of a cut
_RECENT = 31  # frames whose median sharpness is compared with
_VERSION = 3  # of the search; results of another version are not used
_LARGEST = 64 * MAX_FRAMES  # bytes of a file of motion

FrameNumber = Annotated[int, Field(strict=True, ge=0, le=MAX_FRAMES)]


@dataclass
class Piece:
    """Frames in which the motion could be followed throughout; four lists of the same length."""

    frames: list[FrameNumber] = field(default_factory=list)  # ascending
    times: list[FiniteFloat] = field(default_factory=list)  # seconds when they are shown, by the container
    positions: list[FiniteFloat] = field(default_factory=list)  # degrees of parallax since the first
    sharpness: list[FiniteFloat] = field(default_factory=list)

    def is_sound(self) -> bool:
        """Whether there are frames, ascending, each with a time, a position and a sharpness."""
        ascending = bool(self.frames) and self.frames == sorted(set(self.frames))
        lengths = {len(self.frames), len(self.times), len(self.positions), len(self.sharpness)}
        return ascending and len(lengths) == 1


@dataclass
class VideoMotion:
    """The motion in a video, and which of its frames have been written."""

    digest: str  # of the video
    decoded: FrameNumber = 0  # frames
    keys: list[FiniteFloat] = field(default_factory=list)  # seconds, where a search can begin; none: in order
    coarse: bool = False  # whether only those were looked at where the camera moves slowly
    pieces: list[Piece] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    chosen: list[FrameNumber] = field(default_factory=list)  # frames that are, or will be, files
    track: str = ""  # a digest of the recorder's file next to the video, whose places these carry

    def times(self) -> dict[FrameNumber, float]:
        """Seconds when the frames are shown."""
        return {n: t for piece in self.pieces for n, t in zip(piece.frames, piece.times, strict=True)}

    def save(self, path: Path) -> None:
        """Writes it atomically. Raises OSError."""
        write_bytes(path, json.dumps({"version": _VERSION, **asdict(self)}).encode())


def load_motion(path: Path) -> VideoMotion | None:
    """What `save` wrote; None if it is missing, damaged or of another version. Raises OSError."""
    if not path.is_file() or path.stat().st_size > _LARGEST:
        return None
    try:
        content = json.loads(path.read_bytes())
        found = TypeAdapter(VideoMotion).validate_python(content)
    except (ValueError, RecursionError):
        return None
    sound = content.get("version") == _VERSION and all(piece.is_sound() for piece in found.pieces)
    return found if sound else None


@dataclass(frozen=True)
class _Frame:
    number: int
    time: float  # seconds
    grey: NDArray[np.uint8]  # (WIDTH / 2, WIDTH)
    sharpness: float
    clear: bool


class MotionTracker:
    """Follows a camera through the frames of a video, which are added one after the other."""

    def __init__(self, width: int) -> None:
        """`width` is that of the frames, in pixels."""
        self.pieces: list[Piece] = []
        self._sphere = SphereBand(min(WIDTH, width // 2 * 2))
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._anchor: Anchor | None = None
        self._base = 0.0  # degrees, position of the anchor
        self._stray: _Frame | None = None

    def add(self, number: int, time: float, grey: NDArray[np.uint8]) -> None:
        """Adds the next frame, (H, W), and the time in seconds when it is shown.

        One whose motion cannot be measured is left out, such as a flash; two of them, both sharp, begin a new
        piece.
        """
        frame = self._frame(number, time, grey)
        if self._measure(frame):
            self._stray = None
        elif frame.clear:
            if self._stray is not None:
                self._begin(self._stray)
            self._stray = None if self._stray is not None and self._measure(frame) else frame

    def add_near(self, number: int, time: float, grey: NDArray[np.uint8], farthest: float) -> bool:
        """Adds a frame as `add`, some time after the last one, if it is sharp and near enough.

        Returns whether it was added: if not, the frames between are needed. Args: farthest, in degrees of
        parallax.
        """
        if self._anchor is None and self._stray is not None:  # the first frame
            self._begin(self._stray)
            self._stray = None
        if self._anchor is None or self._stray is not None:
            return False
        frame, anchor = self._frame(number, time, grey), copy(self._anchor)
        moved = anchor.measure(frame.grey) if frame.clear else None
        if moved is None or abs(self._base + moved.parallax - self.pieces[-1].positions[-1]) > farthest:
            self._recent.pop()  # comes again, after those between
            return False
        self._anchor = anchor
        self._append(frame, moved)
        return True

    @property
    def pace(self) -> float | None:
        """Degrees from one frame to the next, lately; None where that is not known."""
        last = self.pieces[-1] if self.pieces and self._stray is None else Piece()
        if len(last.frames) < 2:
            return None
        moved, frames = (it[-1] - it[-2] for it in (last.positions, last.frames))
        return abs(moved) / frames

    def is_due(self, number: int, parallax: float, most: int) -> bool:
        """Whether a frame is `most` frames after the last one, or the next would be by more degrees away."""
        if self.pace is None:
            return True
        after = number - self.pieces[-1].frames[-1]
        return after >= most or (after + 1) * self.pace > parallax

    def finish(self) -> list[Piece]:
        """All pieces, after the last frame."""
        if self._stray is not None:
            self._begin(self._stray)
            self._stray = None
        return self.pieces

    def _frame(self, number: int, time: float, grey: NDArray[np.uint8]) -> _Frame:
        grey = _reduced(grey, SHARP_WIDTH)
        sharp = sharpness(grey)
        clear = not self._recent or sharp >= _CLEAR * float(np.median(self._recent))
        self._recent.append(sharp)
        return _Frame(number, time, _reduced(grey, self._sphere.width), sharp, clear)

    def _begin(self, frame: _Frame) -> None:
        """Begins a piece with `frame`, unless too few corners are found in it."""
        anchor = Anchor(self._sphere, frame.grey)
        if anchor.usable:
            self._anchor, self._base = anchor, 0.0
            self.pieces.append(
                Piece([frame.number], [_seconds(frame.time)], [0.0], [_rounded(frame.sharpness)])
            )

    def _measure(self, frame: _Frame) -> bool:
        """Adds `frame` to the present piece, if its motion can be measured."""
        moved = None if self._anchor is None else self._anchor.measure(frame.grey)
        if moved is not None:
            self._append(frame, moved)
        return moved is not None

    def _append(self, frame: _Frame, moved: Displacement) -> None:
        """Adds `frame` to the present piece, and makes it the anchor if that is far or seen no more."""
        piece = self.pieces[-1]
        piece.frames.append(frame.number)
        piece.times.append(_seconds(frame.time))
        piece.positions.append(round(self._base + moved.parallax, 3))
        piece.sharpness.append(_rounded(frame.sharpness))
        if frame.clear and (moved.parallax >= _NEXT or moved.tracked < _LEFT):
            anchor = Anchor(self._sphere, frame.grey)
            if anchor.usable:
                self._anchor = anchor
                self._base += moved.parallax if moved.parallax > _NOISE else 0.0


def sharpness(grey: NDArray[np.uint8]) -> float:
    """How fine the structure of a panorama (H, W) is around its horizon, independent of its exposure.

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
    return grey if grey.shape[1] <= width else resize(grey, (width, width // 2))


def _seconds(time: float) -> float:
    return round(time, 6)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
