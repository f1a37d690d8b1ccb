"""Videos that have not been stitched: both circles in each frame, or a video for each lens.

The second video is another stream of the file, as of Insta360 X4 and X5, or the file next to it whose name
has _10_ in place of _00_, as of ONE X2 and X3. Its frames are joined to those of the first that are shown at
the same time; what follows sees one video of both circles.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from itertools import islice
from pathlib import Path

import av
import av.container
import av.filter
import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.stitching.calibrate import Lenses
from panolog.prepare.stitching.circles import Pixel, halves
from panolog.prepare.stitching.lenses import Pair, Up
from panolog.prepare.stitching.pictures import circles_in, lenses_in, reduced
from panolog.prepare.stitching.stitch import Stitcher
from panolog.prepare.video.colour import ColourError, Converter, Picture, check_colours
from panolog.prepare.video.streams import (
    WIDEST,
    Effort,
    decoded,
    largest_streams,
    open_container,
    prepare_stream,
)

_SAMPLED = 8  # frames in which the lenses are looked for
_LATER = 1.0  # seconds from the first to the second of two of these
_SAME = 0.004  # seconds between two frames that were taken together, at most
_FAR = 100  # frames that are decoded to get to one, at most
_TICK = Fraction(1, 1000)  # the time base in which frames are joined
_FIRST, _SECOND = "_00_", "_10_"  # in the names of the files of the two lenses


Second = tuple[Path, int]  # a file, and which of its largest streams


@dataclass(frozen=True)
class VideoLenses:
    """The lenses of a video, and where the frames of the second one are."""

    pair: Pair
    second: Second | None  # None: in the same frames


@dataclass(frozen=True)
class StitchedLayout:
    """A `Layout` of panoramas that are stitched of frames with both circles."""

    stitcher: Stitcher
    is_whole: bool = True

    @property
    def width(self) -> int:
        """Pixels of the panorama; its height is half of it."""
        return self.stitcher.width

    def scaled(self, width: int) -> "StitchedLayout":
        """The layout of panoramas that are at most `width` pixels wide."""
        return self if width >= self.width else _scaled(self, width)

    def panorama(self, picture: NDArray[Pixel]) -> NDArray[Pixel]:
        """(width / 2, width, ...) of a decoded picture (H, W, ...); colours get the same brightness."""
        height, width = picture.shape[:2]
        across, down = self.stitcher.pair.size
        size = (2 * across, down) if width > height else (across, 2 * down)
        if (width, height) != size:
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), picture.dtype)
        if picture.ndim == 2:
            return self.stitcher.joined(halves(picture))
        colours = halves(np.asarray(picture, np.uint8))
        return np.asarray(self.stitcher.panorama(colours), picture.dtype)

    def mask(self) -> Picture:
        """(width / 2, width) 255: the lenses see all around."""
        return np.full((self.width // 2, self.width), 255, np.uint8)


@lru_cache(maxsize=2)
def stitched_layout(pair: Pair) -> StitchedLayout:
    """The layout that stitches frames of two lenses.

    Kept, as what a stitcher has computed is used again when the video is opened again.
    """
    return StitchedLayout(Stitcher(pair, min(pair.width, WIDEST)))


@lru_cache(maxsize=2)
def _scaled(layout: StitchedLayout, width: int) -> StitchedLayout:
    pair = layout.stitcher.pair.scaled(width / layout.width)
    return replace(layout, stitcher=Stitcher(pair, width))


class SecondLens:
    """The video of the second lens."""

    def __init__(self, container: av.container.InputContainer, stream: av.VideoStream) -> None:
        """Args: container, the open file; stream, the one of its streams to read."""
        self._container, self._stream = container, stream
        self._graph: tuple[object, Joiner] | None = None
        self._restart()

    def seek(self, seconds: float) -> None:
        """The next frames are from there on, or from some before."""
        self._container.seek(round(seconds / (self._stream.time_base or 1)), stream=self._stream)
        self._restart()

    def _restart(self) -> None:
        """Decodes from where the file is."""
        self._frames = decoded(self._container, self._stream)
        self._frame = next(self._frames, None)

    def joined(self, frame: av.VideoFrame) -> av.VideoFrame | None:
        """A frame of the first lens with that of the second next to it; None if there is none of that time.

        Raises av.FFmpegError if they cannot be joined.
        """
        wanted = frame.time or 0.0
        while self._frame is not None and (self._frame.time or 0.0) < wanted - _SAME:
            self._frame = next(self._frames, None)
        other = self._frame
        if other is None or abs((other.time or 0.0) - wanted) > _SAME or other.is_corrupt or frame.is_corrupt:
            return None
        key, key_of_other = ((it.format.name, it.width, it.height) for it in (frame, other))
        if key != key_of_other:
            return None
        if self._graph is None or self._graph[0] != key:
            self._graph = (key, Joiner(frame))
        self._frame = next(self._frames, None)
        return self._graph[1].joined(frame, other)


class Joiner:
    """Puts two frames next to each other, as FFmpeg's filter `hstack` does."""

    def __init__(self, frame: av.VideoFrame) -> None:
        """Args: frame, one of those to join."""
        self._graph = av.filter.Graph()
        self._inputs = [
            self._graph.add_buffer(
                width=frame.width, height=frame.height, format=frame.format, time_base=_TICK
            )
            for _ in range(2)
        ]
        stack, sink = self._graph.add("hstack", "inputs=2"), self._graph.add("buffersink")
        for side, node in enumerate(self._inputs):
            node.link_to(stack, 0, side)
        stack.link_to(sink)
        self._graph.configure()
        self._count = 0

    def joined(self, frame: av.VideoFrame, other: av.VideoFrame) -> av.VideoFrame:
        """Both frames in one, which has the time and the colours of the first. Raises av.FFmpegError."""
        pts, base, is_key = frame.pts, frame.time_base, frame.key_frame
        for node, it in zip(self._inputs, (frame, other), strict=True):
            it.pts, it.time_base = self._count, _TICK
            node.push(it)
        self._count += 1
        both = self._graph.vpull()
        both.pts = pts
        both.key_frame = is_key  # type: ignore[misc]
        if base is not None:
            both.time_base = base
        both.color_range, both.colorspace = frame.color_range, frame.colorspace
        return both


@contextmanager
def open_second(second: Second | None, effort: Effort) -> Iterator[SecondLens | None]:
    """The video of the second lens, if it is one of its own. Raises what opening does."""
    if second is None:
        yield None
        return
    path, row = second
    with open_container(path) as container:
        yield SecondLens(container, prepare_stream(largest_streams(container)[row], effort))


def video_lenses(path: Path, up: Up | None = None) -> VideoLenses | None:
    """The lenses of a video that has not been stitched; None of any other, and of one that cannot be read.

    Raises SceneError if it shows circles, but what both show does not determine the lenses.
    """
    try:
        state = path.stat()
        found = _found(path, state.st_size, state.st_mtime_ns)
        return found if found is None or up is None else replace(found, pair=replace(found.pair, up=up))
    except (OSError, av.FFmpegError, UnicodeError, ColourError):
        return None


@lru_cache(maxsize=4)
def _found(path: Path, _size: int, _changed: int) -> VideoLenses | None:
    """`video_lenses` of a file in this state. Raises what opening and decoding do."""
    with open_container(path) as container:
        streams = largest_streams(container)
        second = _second_of(path, streams)
        if not streams or len(streams) > (1 if second is None else 2):
            return None
        with open_second(second, "exact") as other:
            pictures = list(_samples(container, prepare_stream(streams[0], "exact"), other))
    if not pictures:
        return None
    size = pictures[0][0]
    return VideoLenses(lenses_in(path, size, [both for _, both in pictures]), second)


def _second_of(path: Path, streams: list[av.VideoStream]) -> Second | None:
    """Where the second lens is, if pictures are square."""
    if not streams or streams[0].width != streams[0].height:
        return None
    if len(streams) == 2:
        return (path, 1)
    for names in ((_FIRST, _SECOND), (_SECOND, _FIRST)):
        other = _other_file(path, *names)
        if other is not None and other.is_file():
            return (other, 0)
    return None


def first_lens(path: Path) -> Path | None:
    """The file of the first lens, by the name that Insta360 gives that of the second; None of any other."""
    return _other_file(path, _SECOND, _FIRST) if path.suffix.lower() == ".insv" else None


def _other_file(path: Path, mine: str, of_other: str) -> Path | None:
    """The file next to one whose name has another part in the place of the last of its own."""
    head, found, tail = path.name.rpartition(mine)
    return path.with_name(head + of_other + tail) if found else None


def _samples(
    container: av.container.InputContainer, stream: av.VideoStream, other: SecondLens | None
) -> Iterator[tuple[tuple[int, int], Lenses]]:
    """Frames from all of a video: the size of each lens's picture, and both reduced. None without circles."""
    converter, seconds = Converter(), max(0, container.duration or 0) / av.time_base
    begin = (container.start_time or 0) / av.time_base
    for row in range(_SAMPLED if seconds else 1):
        # Two that follow each other show the same things.
        wanted = begin + seconds * (row - row % 2) / _SAMPLED + row % 2 * min(_LATER, seconds / _SAMPLED)
        if row:
            container.seek(round(wanted * av.time_base))
            if other is not None:
                other.seek(wanted)
        frames = islice(decoded(container, stream), _FAR)
        frame = next((it for it in frames if (it.time or 0.0) >= wanted), None)
        both = frame if frame is None or other is None else other.joined(frame)
        if both is None:
            continue
        check_colours(both)
        picture = converter.bgr(both)
        if row == 0 and not circles_in(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)):
            return
        one = halves(picture)[0]
        yield (one.shape[1], one.shape[0]), reduced(picture)
