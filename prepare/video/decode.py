"""360° videos, frame by frame in order, with their true times; numbers in headers are not trusted."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import av
import av.container
import numpy as np
from av.sidedata.sidedata import SideData
from numpy.typing import NDArray

from panolog.prepare.file_kinds import VIDEOS, describe_file
from panolog.prepare.panorama_files import SUFFIXES
from panolog.prepare.stitching.lenses import APPROXIMATE, Up
from panolog.prepare.video.colour import ColourError, Converter, check_colours
from panolog.prepare.video.layout import Layout, LayoutError, layout_of
from panolog.prepare.video.lenses import (
    SecondLens,
    StitchedLayout,
    VideoLenses,
    open_second,
    stitched_layout,
    video_lenses,
)
from panolog.prepare.video.spherical import read_spherical, spherical_of
from panolog.prepare.video.streams import (
    WIDEST,
    Effort,
    begun,
    decoded,
    largest_streams,
    often,
    open_container,
    prepare_stream,
)
from panolog.scene.errors import SceneError
from panolog.scene.pictures.kinds import STITCH

MAX_FRAMES = 1_000_000  # nine hours at 30 frames per second
_NARROWEST = 256  # pixels: enough to track anything
_SAMPLED = 2**20  # bytes at the beginning, the middle and the end that identify a video
_ENDS_EARLY = 0.95  # of the frames in the header, which is an estimate where there is no index


class Video:
    """An open video of equirectangular frames.

    In many files seeking arrives at another frame than the requested one, while the order of decoding is
    always the same. So a frame counts as found only if it is shown at the very time.
    """

    def __init__(
        self,
        path: Path,
        container: av.container.InputContainer,
        ahead: ThreadPoolExecutor,
        effort: Effort,
        lenses: VideoLenses | None,
        second: SecondLens | None,
    ) -> None:
        """Decodes the first frame and checks how it lies on the sphere.

        Args:
            ahead: a thread that decodes the next frame while the last one is used.
            effort: what decoding may leave out.
            lenses: of a video that is to be stitched; second: the video of the second one, if there is one.

        Raises SceneError: there is no frame, or it is no panorama of a usable size; OSError: the file cannot
        be read.
        """
        self.path = path
        self.decoded = 0  # frames so far
        self.passed = 0  # the same with those that were left out, by the time
        self.first = 0.0  # seconds: when its first frame is shown
        self.time = 0.0  # seconds: when the last frame is shown
        self.is_plain = True  # so far: nothing is damaged, and each frame has a time after the last one
        self.keys: list[float] = []  # seconds, of the frames so far from which decoding can begin
        self._damaged = 0  # packets that cannot be decoded; counted by the other thread
        self._unlike = 0  # frames that cannot be converted
        self._ahead = ahead
        self._container = container
        self._lenses, self._second = lenses, second
        self._stream = _video_stream(path, container, effort, lenses)
        self._by_time = self._stream.codec_context.skip_frame != "DEFAULT"
        self._converter = Converter()
        self._frames = self._decode()
        first = next(self._frames, None)
        if first is None:
            raise SceneError(
                f"{path}: cannot be opened as a video; it is damaged, truncated before its index, or no video"
            )
        self.frame = first  # the last frame, as it was decoded
        self._size = (first.width, first.height)
        try:
            check_colours(first)
            self.layout = self._layout(first)
        except (LayoutError, ColourError) as error:
            raise SceneError(f"{path}: {error}") from error
        self.width, self.height = self.layout.width, self.layout.width // 2
        if not _NARROWEST <= self.width <= WIDEST:
            raise SceneError(
                f"{path}: its frames are {self.width} pixels wide, not {_NARROWEST} to {WIDEST}; "
                "the file is damaged, or export it in another size"
            )
        self.promised = min(
            max(0, self._announced()), path.stat().st_size, MAX_FRAMES
        )  # frames by the header

    @property
    def often(self) -> int:
        """Every how manieth frame is enough of a large video, for `_ENOUGH` a second; 1 of others."""
        return often(self._stream, self.width)

    @property
    def started(self) -> datetime | None:
        """When recording began by the camera's clock, which should be UTC; None if that is not known."""
        return begun(self._container)

    def frames(self) -> Iterator[int]:
        """The numbers of its frames from 0 on, up to MAX_FRAMES; once for each open video.

        `time`, `picture` and `grey` are those of the last one.
        """
        frame: av.VideoFrame | None = self.frame
        while frame is not None and self.passed < MAX_FRAMES:
            # FFmpeg reuses the buffers of frames that are let go, and where a frame is damaged it shows
            # what was in its buffer: so that is done here, at the same moment each time.
            self.frame = frame
            coming = self._ahead.submit(next, self._frames, None)
            self._show(frame)
            yield self.passed - 1
            frame = coming.result()

    def frames_at(self, times: Sequence[float], keys: Sequence[float]) -> Iterator[float]:
        """The `times`, ascending, at which frames are shown; ends at the first one that is not found.

        Args: keys, what `keys` was when all of the video had been decoded.
        """
        self._show(self.frame)
        for wanted in times:
            begin = max((key for key in keys if key <= wanted), default=0.0)
            if begin > self.time or wanted < self.time:
                self._seek(begin)
            while self.time < wanted and (frame := next(self._frames, None)) is not None:
                self.frame = frame
                self._show(frame)
            if self.time != wanted:
                return
            yield wanted

    def between(self, begin: float | None, end: float) -> Iterator[int]:
        """The numbers, by their times, of the frames between two times, in seconds; each call is later.

        Where seeking does not find the first of them, the video is not plain.

        Args: begin, that of a frame from which decoding can begin; None: there are no frames.
        """
        if begin is None:
            return
        self._by_time = True
        if not self.decoded:
            self._show(self.frame)
        self._seek(begin)
        found = False
        for frame in self._frames:
            if round(self._time(frame), 6) >= end:
                break
            self.frame = frame
            self._show(frame)
            found |= self.time == begin
            if self.time > begin:
                yield self.passed - 1
        self.is_plain &= found

    def picture(self, frame: av.VideoFrame | None = None) -> NDArray[np.uint8] | None:
        """(height, width, 3) BGR of `frame`, or the last one; None if it is damaged or unlike the first."""
        return self._converted(frame, lambda it: self.layout.panorama(self._converter.bgr(it)))

    def grey(self, width: int = WIDEST) -> NDArray[np.uint8] | None:
        """(H, W) luma, full range, at most `width` wide, for a fraction of the time of `picture`.

        None as there.
        """
        layout = self.layout.scaled(width)
        return self._converted(None, lambda it: self._converter.grey(it, layout.panorama))

    def notes(self) -> list[str]:
        """Messages about a video that was decoded, one line each."""
        lines = [] if self._lenses is None else [f"{self.path}: {APPROXIMATE}"]
        counted, seconds = self._stream.frames > 0, self._duration()
        there, whole = (self.passed, self.promised) if counted else (self.time + 1, seconds)
        if there < _ENDS_EARLY * whole:
            part = f"{self.decoded:,} of the {self.promised:,} frames"
            if not counted:
                part = f"{self.time:.1f} of the {seconds:.1f} seconds"
            lines.append(
                f"{self.path}: ends after {part} that its header promises; it is truncated or damaged, "
                "what there is was used"
            )
        unusable = self._damaged + self._unlike
        if unusable:
            lines.append(f"{self.path}: {unusable:,} damaged frames, or of another size, were left out")
        if self.passed == MAX_FRAMES:
            lines.append(f"{self.path}: only its first {MAX_FRAMES:,} frames were used; cut it")
        return lines

    def _seek(self, begin: float) -> None:
        """The next frame is that at a time in seconds, from which decoding can begin, or an earlier one."""
        self._container.seek(round(begin / (self._stream.time_base or 1)), stream=self._stream)
        if self._second is not None:
            self._second.seek(begin)
        self._frames, self.time, self.passed = self._decode(), -1.0, 0

    def _decode(self) -> Iterator[av.VideoFrame]:
        """The frames that can be decoded, with those of the second lens next to them if it has its own."""
        for frame in decoded(self._container, self._stream, self._count_damage):
            try:
                both = frame if self._second is None else self._second.joined(frame)
            except av.FFmpegError:
                both = None
            if both is None:
                self._count_damage()
            else:
                yield both

    def _count_damage(self) -> None:
        self._damaged += 1
        self.is_plain = False

    def _converted(
        self, frame: av.VideoFrame | None, convert: Callable[[av.VideoFrame], NDArray[np.uint8]]
    ) -> NDArray[np.uint8] | None:
        """The panorama of a frame, or of the last one."""
        frame = frame or self.frame
        if (frame.width, frame.height) == self._size and not frame.is_corrupt:
            try:
                return convert(frame)
            except (av.FFmpegError, ColourError):
                pass
        self._unlike += 1
        self.is_plain = False
        return None

    def _layout(self, first: av.VideoFrame) -> Layout | StitchedLayout:
        """Raises LayoutError and OSError."""
        if self._lenses is not None:
            self.spherical = None
            return stitched_layout(self._lenses.pair)
        matrix, mapping, stereo = (
            bytes(it) if isinstance(it, SideData) else None
            for it in map(first.side_data.get, ("DISPLAYMATRIX", "SPHERICAL", "STEREO3D"))
        )
        self.spherical = read_spherical(self.path) or spherical_of(mapping, stereo)
        aspect = float(self._stream.sample_aspect_ratio or 1)
        return layout_of(first.width, first.height, matrix, self.spherical, WIDEST, aspect)

    def _show(self, frame: av.VideoFrame) -> None:
        """`frame` is the last one now."""
        time = round(self._time(frame), 6)
        self.is_plain &= frame.pts is not None and (self.decoded == 0 or time > self.time)
        self.time, self.first = time, self.first if self.decoded else time
        self.decoded, self.passed = self.decoded + 1, self.passed + 1
        if self._by_time:
            due = round((time - self.first) * float(self._stream.average_rate or 0)) + 1
            self.passed = max(self.passed, min(due, MAX_FRAMES))
        if frame.key_frame:
            self.keys.append(time)

    def _time(self, frame: av.VideoFrame) -> float:
        """Seconds; of a frame without a time, that of the last one and a little more."""
        if frame.pts is not None and frame.time_base:
            return float(frame.pts * frame.time_base)
        return self.time + (1 / float(self._stream.average_rate or 30) if self.decoded else 0.0)

    def _announced(self) -> int:
        """Frames by the header, or else by its duration; 0 if it says neither."""
        return self._stream.frames or int(self._duration() * (self._stream.average_rate or 0))

    def _duration(self) -> float:
        """Seconds by the header; 0 if it does not say."""
        return max(0, self._container.duration or 0) / av.time_base


@contextmanager
def open_video(path: Path, effort: Effort = "exact", up: Up | None = None) -> Iterator[Video]:
    """Opens a video in any container of `FORMATS` with any codec of FFmpeg; one of two lenses is stitched.

    Args: effort, "exact" decodes all frames in one thread, so that damaged ones are the same each time.
        "fast" decodes in several threads, and of large videos no frames that no others refer to, most of
        which are coded worst; "keys" only those from which decoding can begin.
        up, of a video that is to be stitched, where up is in its first circle; None: up.
    Raises SceneError: it is missing, cannot be opened, is no panorama, or its width is out of bounds.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such video")
    if path.suffix.lower() in SUFFIXES:
        raise SceneError(f"{path}: is one picture; give the folder of the panoramas")
    try:
        container = open_container(path)
    except (av.FFmpegError, UnicodeError) as error:
        other = None if path.suffix.lower() in VIDEOS else describe_file(path)
        reason = other or "it is damaged, truncated before its index, or no video"
        raise SceneError(f"{path}: cannot be opened as a video; {reason}") from error
    with container, ThreadPoolExecutor(1) as ahead:
        lenses = video_lenses(path, up)
        with open_second(None if lenses is None else lenses.second, effort) as second:
            yield Video(path, container, ahead, effort, lenses, second)


def _video_stream(
    path: Path, container: av.container.InputContainer, effort: Effort, lenses: VideoLenses | None
) -> av.VideoStream:
    """The stream of the panoramas, the largest; the first of some that are 2:1. Raises SceneError."""
    streams = largest_streams(container)
    if not streams:
        raise SceneError(f"{path}: there is no video in it that FFmpeg can decode")
    panoramas = streams[0].width == 2 * streams[0].height  # as some cameras store the same twice
    if len(streams) > 1 and lenses is None and not panoramas:
        raise SceneError(f"{path}: it has a video for each lens; {STITCH}")
    return prepare_stream(streams[0], effort)


def video_digest(path: Path) -> str:
    """Identifies a video by its size and three samples, also after it is moved or copied.

    Raises SceneError: it cannot be read.
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
