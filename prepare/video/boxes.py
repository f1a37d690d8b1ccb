"""The boxes of MP4 and QuickTime files, found by their path, whatever sizes and counts a file claims."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

_MOST = 65_536  # boxes of a file that are looked at: a movie has some hundreds
_LARGEST = 2**20  # bytes of a box that is read as a whole
_ENTRY = 78  # bytes of a VisualSampleEntry before its boxes, ISO/IEC 14496-12


@dataclass(frozen=True)
class Box:
    """Where the content of a box is in its file."""

    kind: bytes  # four characters
    start: int  # byte
    end: int  # byte after it, within the box around it


class BoxReader:
    """Reads the boxes of a file. In damaged parts there are none; all methods raise OSError."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        """`size` is that of the file in bytes."""
        self.file = Box(b"", 0, size)
        self._stream = file
        self._left = _MOST

    def find(self, box: Box, path: str) -> list[Box]:
        """All boxes at a path in a box, such as "moov/trak/mdia": the file does not say how deep they are."""
        found = [box]
        for kind in path.encode().split(b"/"):
            found = [inner for outer in found for inner in self.children(outer) if inner.kind == kind]
        return found

    def children(self, box: Box) -> Iterator[Box]:
        """The boxes in a box."""
        at = box.start
        while self._left > 0 and at + 8 <= box.end:
            self._left -= 1
            self._stream.seek(at)
            header = self._stream.read(16)
            if len(header) < 8:
                return
            length, kind = struct.unpack(">I4s", header[:8])
            start = at + 8
            if length == 1 and len(header) == 16:  # its length is in the next eight bytes
                length, start = struct.unpack(">Q", header[8:])[0], at + 16
            end = box.end if length == 0 else at + length
            if end < start:
                return
            yield Box(kind, start, min(end, box.end))
            at = end

    def entries(self, stsd: Box) -> Iterator[Box]:
        """The boxes' part of each entry of a video track's sample descriptions."""
        for entry in self.children(Box(b"stsd", stsd.start + 8, stsd.end)):  # after version and count
            yield Box(entry.kind, min(entry.start + _ENTRY, entry.end), entry.end)

    def read(self, box: Box) -> bytes:
        """The content of a box, up to a mebibyte of it."""
        self._stream.seek(box.start)
        return self._stream.read(max(0, min(box.end - box.start, _LARGEST)))
