"""Colours of decoded frames, by the matrix and the range that their tags name."""

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import av
import av.filter
import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

# Of FFmpeg's AVColorSpace, which is ITU-T H.273, to the names of its filter `scale`.
_MATRICES = {1: "bt709", 4: "fcc", 5: "bt470", 6: "smpte170m", 7: "smpte240m", 9: "bt2020", 10: "bt2020"}
_RGB, _UNTAGGED = 0, 2
_FULL = 2  # of AVColorRange
_HDR = {16: "PQ", 18: "HLG"}  # of AVColorTransferCharacteristic
_HIGH = 576  # rows: untagged frames of more are BT.709, as in players, and others BT.601
_FLAGS = "bicubic+accurate_rnd+full_chroma_int+bitexact"  # rounded correctly, the same on all processors
_PLANAR = re.compile(r"yuvj?a?4\d\dp(?:(\d+)le)?")  # names of formats whose first plane is the luma


class ColourError(ValueError):
    """Why frames cannot become pictures, and what to do."""


class Converter:
    """Converts the frames of a video to 8 bits, full range. Keeps what FFmpeg prepares for that.

    Its methods raise ColourError as `check_colours` does, and av.FFmpegError if FFmpeg cannot convert it.
    """

    def __init__(self) -> None:
        self._key: object = None
        self._graph: av.filter.Graph | None = None

    def bgr(self, frame: av.VideoFrame) -> Picture:
        """(H, W, 3) BGR."""
        key = (frame.format.name, frame.width, frame.height, *check_colours(frame))
        if self._graph is None or self._key != key:
            self._key, self._graph = key, _graph(frame)
        self._graph.push(frame)
        return np.asarray(self._graph.vpull().to_ndarray(), np.uint8)

    def grey(self, frame: av.VideoFrame, placed: Callable[[NDArray[Any]], NDArray[Any]]) -> Picture:
        """(H, W) the luma of the panorama, where possible without a conversion.

        Args: placed, makes the panorama of a picture (H, W), as `Layout.panorama`.
        """
        found = _PLANAR.fullmatch(frame.format.name)
        bits = int(found.group(1) or 8) if found else 0
        if not 8 <= bits <= 16:
            return placed(np.asarray(cv2.cvtColor(self.bgr(frame), cv2.COLOR_BGR2GRAY), np.uint8))
        plane = frame.planes[0]
        values = np.frombuffer(memoryview(plane), np.uint8 if bits == 8 else "<u2")
        luma = placed(values.reshape(plane.height, -1)[:, : plane.width])
        levels = _levels(bits, check_colours(frame)[1])
        return np.asarray(cv2.LUT(luma, levels) if bits == 8 else levels[luma & (2**bits - 1)], np.uint8)


def check_colours(frame: av.VideoFrame) -> tuple[str, str]:
    """The matrix and the range of a frame, as the filter `scale` calls them.

    Raises ColourError: it is HDR, or its matrix is not known.
    """
    if frame.color_trc in _HDR:
        raise ColourError(f"its frames are HDR ({_HDR[frame.color_trc]}); export it in SDR, BT.709")
    space = frame.colorspace
    if space in (_RGB, _UNTAGGED):
        matrix = "bt709" if frame.height > _HIGH else "smpte170m"
    elif space in _MATRICES:
        matrix = _MATRICES[space]
    else:
        raise ColourError(f"the colours of its frames are coded in a rare way ({space}); export it in BT.709")
    full = frame.color_range == _FULL or frame.format.is_rgb or frame.format.name.startswith("yuvj")
    return matrix, "pc" if full else "tv"


def _graph(frame: av.VideoFrame) -> av.filter.Graph:
    """Converts frames such as this one to BGR. Raises av.FFmpegError."""
    matrix, range_ = check_colours(frame)
    graph = av.filter.Graph()
    graph.link_nodes(
        graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
        ),
        graph.add("scale", f"flags={_FLAGS}:in_range={range_}:out_range=pc:in_color_matrix={matrix}"),
        graph.add("format", "bgr24"),
        graph.add("buffersink"),
    ).configure()
    return graph


@cache
def _levels(bits: int, range_: str) -> Picture:
    """(2^bits,) of 8 bits, full range, for each value of the luma."""
    values = np.arange(2**bits) / 2 ** (bits - 8)
    scaled = (values - 16) * 255 / 219 if range_ == "tv" else values
    return np.asarray(np.clip(np.rint(scaled), 0, 255), np.uint8)
