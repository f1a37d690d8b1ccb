"""Whether a JPEG has lost pixels, or the finer scans of a progressive one, but not its end marker.

Programs put that there again. OpenCV makes what is missing grey, or blurred, without a word.
Layout: ITU T.81.
"""

import re
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.pictures.profiles import JPEG_SCAN, jpeg_segments

_BLOCK = 2  # pixels of a row that a JPEG loses at once, at least, reduced eight times
_GREY, _MORE = 128, b"\x55\x2a" * 32  # what missing pixels are; bytes that any code decodes
_MARKER = re.compile(rb"\xff+([\x01-\xcf\xd8-\xfe])")  # in a scan, FF 00 and restarts are none
_PROGRESSIVE, _END = 0xC2, 0xD9
_UNSENT = 15  # bits of a coefficient that no scan has


def is_cut(data: bytes, pixels: NDArray[Any], flags: int) -> bool:
    """Whether a JPEG that has an end marker has lost its last pixels or scans.

    Args: data, the file; pixels (H, W) or (H, W, 3), as `cv2.imdecode` has made them with `flags`.
    """
    progressive = any(marker == _PROGRESSIVE for marker, _ in jpeg_segments(BytesIO(data)))
    if not progressive and (pixels[-1, -_BLOCK:] != _GREY).any():
        return False
    whole, end = _scans(data)
    if not whole:
        return True
    # In a whole file what is put in front of the end marker changes nothing.
    longer = np.frombuffer(data[:end] + _MORE + data[end:], np.uint8)
    again = cv2.imdecode(longer, flags)
    return again is None or not np.array_equal(again, pixels)


def _scans(data: bytes) -> tuple[bool, int]:
    """Whether the scans of a JPEG have all bits of a progressive one, and where its end marker is.

    Not without an end marker.
    """
    at, unsent = 2, dict[int, NDArray[np.int64]]()
    while (found := _MARKER.search(data, at)) is not None:
        marker, start = found[1][0], found.end()
        if marker == _END:
            return not any(bits.any() for bits in unsent.values()), found.start()
        at = start + int.from_bytes(data[start : start + 2], "big")
        content = data[start + 2 : at]
        if marker == _PROGRESSIVE:
            unsent = {id: np.full(64, _UNSENT) for id in content[6::3]}
        elif marker == JPEG_SCAN and unsent and len(content) > 3:
            first, last, bits = content[-3:]
            for id in content[1:-3:2]:
                if id in unsent:
                    unsent[id][first : last + 1] = bits & 15
    return False, -1
