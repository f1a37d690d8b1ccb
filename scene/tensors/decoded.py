"""Pixels of masks and depth maps, compressed in memory: their files take longer to decode than pictures."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from panolog.scene.files import Locate, here

_LEVEL = 1  # of Zstandard: a higher one takes longer and hardly less memory


@dataclass(frozen=True)
class _Packed:
    """Pixels without loss: of 16 bits the lower bytes and then the upper ones, which are alike."""

    shape: tuple[int, ...]
    wide: bool  # uint16, else uint8
    data: bytes

    @staticmethod
    def of(pixels: NDArray[Any]) -> "_Packed":
        """Args: pixels, bool, uint8 or uint16."""
        wide = pixels.itemsize == 2
        halves = np.stack([pixels & 255, pixels >> 8]).astype(np.uint8) if wide else pixels
        return _Packed(pixels.shape, wide, zstandard.compress(np.ascontiguousarray(halves).data, _LEVEL))

    def pixels(self) -> NDArray[Any]:
        """The pixels as they were given."""
        found = np.frombuffer(zstandard.decompress(self.data), np.uint8)
        if not self.wide:
            return found.reshape(self.shape)
        low, high = found.reshape(2, -1)
        return (high.astype(np.uint16) << 8 | low).reshape(self.shape)


class DecodedLayers:
    """The files of the layers of some panoramas. Those that are decoded first stay while there is room."""

    def __init__(self, room: int = 0, locate: Locate = here) -> None:
        """Args: room, bytes in memory; locate, where the files are."""
        self._room, self._locate = room, locate
        self._kept: dict[Path, _Packed] = {}
        self._lock = threading.Lock()

    def pixels(self, path: Path, decode: Callable[[Path], NDArray[Any]]) -> NDArray[Any]:
        """What `decode` makes of a file, to be read only, bool perhaps as uint8; any thread may call it.

        Args: decode, the same for each call with a path. Raises as it does.
        """
        if (packed := self._kept.get(path)) is not None:
            return packed.pixels()
        pixels = decode(self._locate(path))
        if self._room > 0:
            packed = _Packed.of(pixels)
            with self._lock:
                if path not in self._kept and len(packed.data) <= self._room:
                    self._room -= len(packed.data)
                    self._kept[path] = packed
        return pixels
