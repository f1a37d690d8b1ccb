"""Panoramas for networks of perspective pictures: square views that cover the sphere, and back.

Such networks know people upright and undistorted, as an operator below the camera is nowhere in a panorama.
So they get views with the horizon in the middle, views tilted up and down, and one straight up and one down,
each of which overlaps its neighbours by a third.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import ceil, cos, pi, radians, tan

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
_APART = 2 / 3  # of the field of view, at most: between the middles of neighbours
_COUNTS = 15 / 16  # of a view to each side: what a network sees cut off at its border is less sure


@dataclass(frozen=True)
class Row:
    """Views of one tilt, evenly spaced around."""

    pitch: float  # radians above the horizon
    count: int


@dataclass(frozen=True)
class Tiles:
    """Square views of a panorama, `size` pixels wide and `fov` degrees across."""

    size: int
    fov: float

    @property
    def width(self) -> int:
        """Columns of a panorama whose pixels at the horizon are those in the middle of a view; even."""
        return 2 * ceil(pi * self.size / (2 * tan(radians(self.fov) / 2)))

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """The rows of views, from the nadir to the zenith."""
        most = self.fov * _APART
        each = ceil(90 / most)  # rows from the horizon to a pole
        step = 90 / each
        rows = []
        for turn in range(-each, each + 1):
            widest = cos(radians(max(0.0, (abs(turn) - 0.5) * step)))  # circle that this row has to cover
            count = 1 if abs(turn) == each else ceil(360 * widest / most)
            rows.append(Row(radians(turn * step), count))
        return tuple(rows)

    def views(self, panorama: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(K, size, size, 3) of a panorama (width / 2, width, 3)."""
        return np.stack(
            [
                cv2.remap(np.roll(panorama, -shift, axis=1), *maps, cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
                for (maps, _), shift in self._each()
            ]
        ).astype(np.uint8)

    def joined(self, found: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(width / 2, width) what any of the views (K, h, h) shows, whose borders do not count."""
        joined = np.zeros((self.width // 2, self.width), bool)
        for view, ((_, maps), shift) in zip(found, self._each(), strict=True):
            if view.any():
                scaled = cv2.resize(
                    view.astype(np.uint8), (self.size, self.size), None, 0, 0, cv2.INTER_NEAREST
                )
                back = cv2.remap(scaled, *maps, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, 0)
                joined |= np.roll(back, shift, axis=1) > 0
        return joined

    def _each(self) -> Iterator[tuple[tuple[tuple[Floats, Floats], tuple[Floats, Floats]], int]]:
        """The maps of each view, and by how many columns it is turned from the middle of the panorama."""
        for row, maps in zip(self.rows, self._maps, strict=True):
            for turn in range(row.count):
                yield maps, round(turn * self.width / row.count)

    @cached_property
    def _maps(self) -> list[tuple[tuple[Floats, Floats], tuple[Floats, Floats]]]:
        """For each row: where a view lies in the panorama, and where the panorama lies in the view."""
        return [(self._to_panorama(row.pitch), self._to_view(row.pitch)) for row in self.rows]

    def _to_panorama(self, pitch: float) -> tuple[Floats, Floats]:
        """Columns and rows (size, size) of a panorama; a view looks at its middle, tilted by `pitch`."""
        across = ((np.arange(self.size) + 0.5) / self.size * 2 - 1) * tan(radians(self.fov) / 2)
        x, y = np.meshgrid(across, across)
        up, forward = _tilted(-y, np.ones_like(y), pitch)
        azimuth, elevation = np.arctan2(x, forward), np.arctan2(up, np.hypot(x, forward))
        columns = (azimuth / (2 * pi) + 0.5) * self.width - 0.5
        rows = (0.5 - elevation / pi) * (self.width // 2) - 0.5
        return columns.astype(np.float32), np.clip(rows, 0, self.width // 2 - 1).astype(np.float32)

    def _to_view(self, pitch: float) -> tuple[Floats, Floats]:
        """Columns and rows (width / 2, width) of a view, -1 where the panorama is not in it."""
        height = self.width // 2
        elevation = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * pi
        azimuth = ((np.arange(self.width) + 0.5) / self.width - 0.5) * 2 * pi
        x, level = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
        up, forward = _tilted(np.sin(elevation) + 0 * azimuth, level, -pitch)
        ahead = np.where(forward > 0, forward, np.inf) * tan(radians(self.fov) / 2)
        right, down = x / ahead, -up / ahead
        inside = (forward > 0) & (np.maximum(abs(right), abs(down)) <= _COUNTS)
        columns, rows = (np.where(inside, (it + 1) / 2 * self.size - 0.5, -1e4) for it in (right, down))
        return columns.astype(np.float32), rows.astype(np.float32)


def _tilted(up: NDArray[np.float64], forward: NDArray[np.float64], pitch: float) -> tuple[Floats, Floats]:
    """What is up and forward in a camera that is tilted up by `pitch`, as up and forward of a level one."""
    sine, cosine = np.sin(pitch), np.cos(pitch)
    return up * cosine + forward * sine, forward * cosine - up * sine
