"""How FFmpeg opens video files and decodes their streams; what files say is not trusted."""

import os
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

import av
import av.container
from av.stream import Disposition

WIDEST = 12_288  # pixels: more than any camera records
FORMATS = "mov,matroska,avi,mpegts,mpeg,flv,ogg,asf"  # no playlists: they name other files and addresses
Effort = Literal["exact", "fast", "keys"]
_THREADS = 8  # of a video at most: each holds a frame
_LARGE = 3000  # pixels: narrower frames are decoded fast enough
_FAST, _ENOUGH = 20, 7.5  # frames per second, of which every second one will do; that are looked at, at least
_DECODING = {
    "max_pixels": str(WIDEST**2),  # two eyes above each other
    "err_detect": "explode",  # rather than to patch frames up
}
_NO_CLOCK = 2000  # years up to this one are those of a clock that was never set
_OPTIONS = {"format_whitelist": FORMATS, "protocol_whitelist": "file", **_DECODING}


def open_container(path: Path) -> av.container.InputContainer:
    """Opens a file. Raises av.FFmpegError and UnicodeError if it is no video."""
    return av.open(str(path.resolve()), options=_OPTIONS, metadata_errors="replace")


def begun(container: av.container.InputContainer) -> datetime | None:
    """When recording began by the camera's clock, which should be UTC; None if that is not known."""
    text = container.metadata.get("creation_time", "")
    try:
        found = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        return None
    return found.astimezone(timezone.utc) if found.tzinfo and found.year > _NO_CLOCK else None


def largest_streams(container: av.container.InputContainer) -> list[av.VideoStream]:
    """The streams of video that can be decoded, of the largest size."""
    streams = [
        it
        for it in container.streams.video
        if it.codec_context is not None and not it.disposition & Disposition.attached_pic
    ]
    largest = max(streams, key=lambda it: it.width * it.height, default=None)
    return [it for it in streams if largest and (it.width, it.height) == (largest.width, largest.height)]


def first_shown(container: av.container.InputContainer) -> float:
    """Seconds at which its first picture is shown: not at 0 in MPEG-TS, nor where a video was cut."""
    stream = next(iter(largest_streams(container)), None)
    return 0.0 if stream is None else float((stream.start_time or 0) * (stream.time_base or 0))


def prepare_stream(stream: av.VideoStream, effort: Effort) -> av.VideoStream:
    """The stream, which leaves out what `effort` allows."""
    if effort != "exact":
        stream.thread_type = "AUTO"
    stream.thread_count = 1 if effort == "exact" else min(_THREADS, os.cpu_count() or 1)
    if effort != "exact" and stream.width >= _LARGE and (stream.average_rate or 0) >= _FAST:
        stream.codec_context.skip_frame = "NONREF"
    if effort == "keys":
        stream.codec_context.skip_frame = "NONKEY"
    stream.codec_context.options = _DECODING
    return stream


def often(stream: av.VideoStream, width: int) -> int:
    """Every how manieth frame is enough of a large video, for `_ENOUGH` a second; 1 of others."""
    return 1 if width < _LARGE else max(1, int(float(stream.average_rate or 0) / _ENOUGH))


def decoded(
    container: av.container.InputContainer, stream: av.VideoStream, damaged: Callable[[], None] = lambda: None
) -> Iterator[av.VideoFrame]:
    """The frames of a stream that can be decoded, from where its file is.

    Args: damaged, called for each packet that cannot be decoded.
    """
    try:
        for packet in container.demux(stream):
            try:
                yield from packet.decode()
            except av.FFmpegError:
                damaged()
    except av.FFmpegError:  # the rest of the file cannot be read
        return
