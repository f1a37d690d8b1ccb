"""Panoramas of pictures of two fisheye lenses whose geometry is known."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.stitching.calibrate import Lenses
from panolog.prepare.stitching.circles import Picture, Pixel
from panolog.prepare.stitching.lenses import Pair, Up
from panolog.prepare.stitching.light import gains

_BLEND = np.deg2rad(2.0)  # on either side of the seam: what is near is double there
_ROWS = 128  # of a panorama that are computed together
_TURNS: dict[Up, int] = {"up": 0, "right": 90, "down": 180, "left": 270}  # degrees clockwise


@dataclass(frozen=True)
class _Part:
    """Rows of the panorama, as one lens shows them."""

    rows: slice
    columns: NDArray[np.intp]
    maps: tuple[NDArray[Any], NDArray[Any]]  # as OpenCV's `remap` takes them
    weight: NDArray[np.float16]  # (rows, columns) its share, over its light there


@dataclass(frozen=True)
class Stitcher:
    """Stitches pictures of one camera; what it needs for that is computed at the first one."""

    pair: Pair
    width: int  # pixels of the panorama

    def panorama(self, both: Lenses) -> Picture:
        """(width / 2, width, 3) of the pictures of both lenses, brought to the same brightness."""
        return self.joined(both, gains(self.pair, both))

    def joined(
        self, both: tuple[NDArray[Pixel], NDArray[Pixel]], gain: NDArray[np.float64] | None = None
    ) -> NDArray[Pixel]:
        """(width / 2, width, ...) of pictures (H, W, ...) of both lenses.

        Args: gain, (channels,) by which the first lens is darker, of which each gets half; None: 1.
        """
        shape: tuple[int, ...] = (self.width // 2, self.width, *both[0].shape[2:])
        whole = np.zeros(shape, both[0].dtype)
        factors = (1.0, 1.0) if gain is None else (np.sqrt(gain), 1 / np.sqrt(gain))
        highest = np.iinfo(both[0].dtype).max
        for parts in self._parts:
            rows = parts[0].rows
            mixed = np.zeros((rows.stop - rows.start, *shape[1:]), np.float32)
            for part, picture, factor in zip(parts, both, factors, strict=True):
                found = cv2.remap(picture, *part.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                weight = part.weight.astype(np.float32)
                weight = weight.reshape(weight.shape + (1,) * (found.ndim - 2))
                mixed[:, part.columns] += found * (weight * np.asarray(factor, np.float32))
            whole[rows] = np.clip(mixed + 0.5, 0, highest).astype(whole.dtype)
        return whole

    @cached_property
    def _parts(self) -> list[tuple[_Part, _Part]]:
        """What both lenses show of all rows."""
        height = self.width // 2
        return [self._part(slice(top, min(top + _ROWS, height))) for top in range(0, height, _ROWS)]

    def _part(self, rows: slice) -> tuple[_Part, _Part]:
        """What both lenses show of some rows: each all that it sees better, and some degrees more."""
        around = ((np.arange(self.width) + 0.5) / self.width * 2 - 1) * np.pi
        below = ((np.arange(rows.start, rows.stop) + 0.5) / self.width * 2 - 0.5)[:, None] * np.pi
        level = np.cos(below)
        local = (level * np.sin(around), np.sin(below) + 0 * around, level * np.cos(around))
        turned = np.deg2rad(_TURNS[self.pair.up])
        x = local[0] * np.cos(turned) - local[1] * np.sin(turned)
        y = local[0] * np.sin(turned) + local[1] * np.cos(turned)
        directions = np.stack([x, y, local[2]], axis=-1)
        first = np.clip(np.arcsin(np.clip(local[2], -1, 1)) / (2 * _BLEND) + 0.5, 0, 1)
        first = first * first * (3 - 2 * first)
        shown = [lens.project(directions) for lens in self.pair.lenses]
        there, there_too = (self.pair.shows(*it) for it in shown)
        first = np.where(
            there & there_too, first, np.where(there_too, 0.0, np.where(there, 1.0, first.round()))
        )
        found = []
        for (pixels, angle), share in zip(shown, (first, 1 - first), strict=True):
            weight = (share / self.pair.light(angle)).astype(np.float16)
            columns = np.flatnonzero(weight.any(axis=0))
            at = (pixels[:, columns] - 0.5).astype(np.float32)
            maps = cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)
            one, other = (np.asarray(it) for it in maps)
            found.append(_Part(rows, columns, (one, other), weight[:, columns]))
        return found[0], found[1]
