"""360° videos, frame by frame in order; numbers in headers are not trusted."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import SceneError

MAX_FRAMES = 1_000_000  # nine hours at 30 frames per second
_WIDTHS = (256, 12_288)  # pixels: enough to track anything, and more than any camera records
_SAMPLED = 2**20  # bytes at the beginning, the middle and the end that identify a video
_ENDS_EARLY = 0.95  # of the frames in the header, which is an estimate where there is no index


class Video:
    """An open video of equirectangular frames.

    There is no seeking: in many files it arrives at another frame than the requested one, while the order
    of decoding is always the same.
    """

    def __init__(self, path: Path, capture: Any) -> None:
        """Checks what the header says of the open `cv2.VideoCapture`.

        Raises:
            SceneError: it is not 2:1, or of a width that no panorama has.
        """
        # Upside down is a rotation of the sphere, so it can be undone; a quarter turn of the image is none.
        upside_down = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360 == 180
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, float(upside_down))
        self.path = path
        self.width, self.height = (
            _count(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        self.promised = min(
            _count(capture.get(cv2.CAP_PROP_FRAME_COUNT)), path.stat().st_size, MAX_FRAMES
        )  # frames by the header; no frame takes less than a byte
        self.decoded = 0  # frames so far
        self.unusable = 0  # of those that `picture` was called for
        self._capture = capture
        if self.width and self.width != 2 * self.height:
            raise SceneError(
                f"{path}: its frames of {self.width} x {self.height} pixels are not 2:1; "
                "stitch it and export it as equirectangular 2:1 (mono) first"
            )
        if not _WIDTHS[0] <= self.width <= _WIDTHS[1]:
            raise SceneError(
                f"{path}: its header says that frames are {self.width} pixels wide, not {_WIDTHS[0]} to "
                f"{_WIDTHS[1]}; the file is damaged, or export it in another size"
            )

    def frames(self) -> Iterator[int]:
        """The numbers of its frames from 0 on, up to MAX_FRAMES; `picture` is that of the last one."""
        while self.decoded < MAX_FRAMES and self._capture.grab():
            self.decoded += 1
            yield self.decoded - 1

    def picture(self) -> NDArray[np.uint8] | None:
        """(height, width, 3) BGR; None if it is damaged or of another size than the first one."""
        done, pixels = self._capture.retrieve()
        if not done or pixels.shape != (self.height, self.width, 3):
            self.unusable += 1
            return None
        return np.asarray(pixels, np.uint8)

    def notes(self) -> list[str]:
        """Messages about a video that was decoded, one line each."""
        lines = []
        if self.decoded < _ENDS_EARLY * self.promised:
            lines.append(
                f"{self.path}: ends after {self.decoded:,} of the {self.promised:,} frames that its header "
                "promises; it is truncated or damaged, what there is was used"
            )
        if self.unusable:
            lines.append(f"{self.path}: {self.unusable:,} damaged frames, or of another size, were left out")
        if self.decoded == MAX_FRAMES:
            lines.append(f"{self.path}: only its first {MAX_FRAMES:,} frames were used; cut it")
        return lines


@contextmanager
def open_video(path: Path) -> Iterator[Video]:
    """Opens any video that the FFmpeg of OpenCV reads.

    Raises:
        SceneError: it is missing, cannot be opened, is not 2:1, or its width is out of bounds.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such video")
    capture = _opened(path)
    try:
        if not capture.isOpened():
            raise SceneError(
                f"{path}: cannot be opened as a video; it is damaged, truncated before its index, or no video"
            )
        yield Video(path, capture)
    finally:
        capture.release()


def _opened(path: Path) -> Any:
    """A `cv2.VideoCapture`, open or not, without messages of its own."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        return cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)


def video_digest(path: Path) -> str:
    """Identifies a video by its size and three samples, also after it is moved or copied.

    Raises:
        SceneError: it cannot be read.
    """
    try:
        size = path.stat().st_size
        found = hashlib.sha256(str(size).encode())
        with path.open("rb") as file:
            for start in (0, size // 2, max(0, size - _SAMPLED)):
                file.seek(start)
                found.update(file.read(_SAMPLED))
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    return found.hexdigest()


def is_two_fisheyes(grey: NDArray[np.uint8]) -> bool:
    """Whether a frame (H, W) is not a panorama but two circles side by side: black around, bright within.

    Near its top and bottom a panorama shows the poles, so all pixels of a row there are similar.
    """
    height, width = grey.shape
    rows = np.concatenate([grey[: max(1, height // 40)], grey[-max(1, height // 40) :]])
    phase = np.abs((np.arange(width) + 0.5) / width % 0.5 - 0.25)  # widths from the middle of a circle
    around, within = rows[:, phase > 0.17], rows[:, phase < 0.02]
    return float(np.percentile(around, 99)) < 16 and float(within.mean()) > 40


def _count(value: float) -> int:
    """A number of the header; 0 if it is invalid."""
    return int(value) if 0 < value < 2**53 else 0
