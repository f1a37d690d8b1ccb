"""The parallax between a frame and an anchor frame, of a camera that may also turn.

Each later frame is turned back into the anchor's orientation before corners are tracked from the anchor to it
(pyramidal Lucas-Kanade). So tracks are as short as the parallax, there is no drift while the camera stands,
and the distortion of the panorama is the same in both frames.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
WIDTH = 640  # pixels of the frames that are compared: 0.56 degrees each
MIN_CORNERS = 30  # of an anchor
_CORNERS = 700
_DISTANCE = 9  # pixels between corners
_BAND = (-60.0, 45.0)  # degrees of latitude, down positive, where corners are: below is the operator
_MARGIN = 15.0  # degrees beyond, which may be tracked into
_PAD = 32  # columns repeated beyond the seam
_WINDOW = (15, 15)  # pixels of a track
_LEVELS = 3
_BACK = 1.0  # pixels between a corner and its track followed forth and back, at most
_LOST = 0.25  # of the corners: fewer tracks are chance
_TURNED = np.deg2rad(0.5)  # a smaller correction of the rotation ends the rounds
_ROUNDS = 3
_STEPS = 15  # of the fit of a rotation
_SMALL = 0.005  # radians; a smaller parallax hardly determines the direction of the motion
_POLE = 0.1  # sine of the angle to that direction within which vectors determine less
_EXACT = 1e-3  # radians; smaller errors count alike


@dataclass(frozen=True)
class Displacement:
    """The motion of a frame against its anchor."""

    parallax: float  # degrees, median over the directions of all corners, rotation taken out
    tracked: float  # fraction of the anchor's corners


class SphereBand:
    """The pixels of panoramas (width / 2, width) whose band of latitudes is cut out, its seam padded."""

    def __init__(self, width: int) -> None:
        self.width, self.height = width, width // 2
        top, bottom = (self._row(edge) for edge in (_BAND[0] - _MARGIN, _BAND[1] + _MARGIN))
        self.top, self.rows = top, bottom - top
        self.inner = slice(self._row(_BAND[0]) - top, self._row(_BAND[1]) - top)
        grid = np.stack(np.meshgrid(np.arange(-_PAD, width + _PAD), np.arange(top, bottom)), axis=-1)
        self._grid = self._directions(grid.reshape(-1, 2)).astype(np.float32)[None]  # (1, all pixels, 3)

    def turned(self, grey: NDArray[np.uint8], rotation: Array) -> NDArray[np.uint8]:
        """(rows, width + 2 pads) the band as a camera sees it whose directions are those of `grey`'s turned.

        `rotation` (3, 3) takes directions of that camera to directions of the one that took `grey` (H, W).
        """
        # Not by `@`: NumPy's threads for it spin for longer than they compute.
        x, y, z = np.asarray(cv2.transform(self._grid, rotation), np.float32)[0].T
        u = np.arctan2(x, z) * np.float32(self.width / (2 * np.pi)) + np.float32(self.width / 2 - 0.5)
        v = np.arcsin(np.clip(y, -1, 1)) * np.float32(self.height / np.pi) + np.float32(self.height / 2 - 0.5)
        shape = (self.rows, self.width + 2 * _PAD)
        sampled = cv2.remap(
            grey, u.reshape(shape), v.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        return np.asarray(sampled, np.uint8)

    def bearings(self, pixels: NDArray[np.float32]) -> Array:
        """(N, 3) unit directions, x right, y down, z forward, of OpenCV's pixels (N, 2) of the band."""
        return self._directions(pixels.astype(np.float64) + np.array([-_PAD, self.top]))

    def pixels(self, bearings: Array, near: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, 2) pixels of the band of unit directions (N, 3), on the side of the seam of `near` (N, 2)."""
        x, y, z = bearings.T
        u = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * self.width - 0.5 + _PAD
        u += self.width * np.rint((near[:, 0] - u) / self.width)
        v = (np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * self.height - 0.5 - self.top
        return np.stack([u, v], axis=1).astype(np.float32)

    def _directions(self, pixels: NDArray[np.float64] | NDArray[np.int64]) -> Array:
        """(N, 3) of OpenCV's pixels (N, 2) of the panorama, whose centres are at whole numbers."""
        longitude = ((pixels[:, 0] + 0.5) / self.width - 0.5) * 2 * np.pi
        latitude = ((pixels[:, 1] + 0.5) / self.height - 0.5) * np.pi
        flat = np.cos(latitude)
        return np.stack(
            [flat * np.sin(longitude), np.sin(latitude), flat * np.cos(longitude)], axis=1, dtype=np.float64
        )

    def _row(self, latitude: float) -> int:
        return round((latitude / 180 + 0.5) * self.height)


class Anchor:
    """A frame that later ones are measured against."""

    def __init__(self, sphere: SphereBand, grey: NDArray[np.uint8]) -> None:
        """Finds the corners of `grey` (H, W)."""
        self._sphere = sphere
        self._image = sphere.turned(grey, np.eye(3))
        self._corners = _corners(sphere, self._image)  # (N, 2)
        self._bearings = sphere.bearings(self._corners)  # (N, 3)
        self._seen = self._bearings  # (N, 3) where they were seen last, in the anchor's axes
        self._ever = np.zeros(len(self._corners), bool)  # seen at all
        self._rotation: Array = np.eye(3)  # from the anchor's axes to those of the frame measured last

    @property
    def usable(self) -> bool:
        """Whether there are enough corners."""
        return len(self._corners) >= MIN_CORNERS

    def measure(self, grey: NDArray[np.uint8]) -> Displacement | None:
        """The motion of a frame (H, W), normally the next one; None if too few corners are found."""
        moved = self._follow(grey, self._rotation)
        if moved is None:  # after a fast turn, or frames too blurred to follow
            moved = self._follow(grey, self._rotation @ self._yaw(grey))
        return moved

    def _follow(self, grey: NDArray[np.uint8], rotation: Array) -> Displacement | None:
        """The displacement, from an estimate of the rotation (3, 3)."""
        seen = self._seen
        for _ in range(_ROUNDS):
            image = self._sphere.turned(grey, rotation)
            pixels, found = self._track(image, self._sphere.pixels(seen, self._corners))
            if found.sum() < max(_LOST * len(found), MIN_CORNERS // 2):
                return None
            bearings = self._sphere.bearings(pixels)
            turn = turn_between(self._bearings[found], bearings[found])
            rotation = rotation @ turn
            seen = np.where(found[:, None], bearings @ turn, seen)
            if np.trace(turn) > 1 + 2 * np.cos(_TURNED):
                break
        self._rotation, self._seen, self._ever = rotation, seen, self._ever | found
        # Near corners are lost first. Their last position is enough to know that they are above the median.
        angles = np.linalg.norm(seen - self._bearings, axis=1)[self._ever]
        return Displacement(float(np.rad2deg(np.median(angles))), float(found.mean()))

    def _track(
        self, image: NDArray[np.uint8], guess: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(N, 2) the corners in `image`, and (N,) which of them are found: tracked back, they return."""
        tracked, found, _ = cv2.calcOpticalFlowPyrLK(
            self._image,
            image,
            self._corners,
            guess.copy(),
            winSize=_WINDOW,
            maxLevel=_LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        there = np.asarray(tracked, np.float32)
        back, again, _ = cv2.calcOpticalFlowPyrLK(
            image, self._image, there, np.empty_like(there), winSize=_WINDOW, maxLevel=_LEVELS
        )
        home = np.linalg.norm(back - self._corners, axis=1) < _BACK
        inside = (there[:, 1] >= 0) & (there[:, 1] <= self._sphere.rows - 1)
        return there, (found[:, 0] == 1) & (again[:, 0] == 1) & home & inside

    def _yaw(self, grey: NDArray[np.uint8]) -> Array:
        """(3, 3) the turn about the vertical that the picture has made since the last rotation known."""
        inner = slice(_PAD, -_PAD)
        first, second = (
            np.asarray(image[:, inner], np.float32)
            for image in (self._image, self._sphere.turned(grey, self._rotation))
        )
        window = np.repeat(np.hanning(self._sphere.rows)[:, None], self._sphere.width, axis=1)
        (shift, _), _ = cv2.phaseCorrelate(first, second, window.astype(np.float32))
        angle = shift * 2 * np.pi / self._sphere.width
        return np.array(
            [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
        )


def turn_between(before: Array, after: Array) -> Array:
    """The rotation (3, 3) of a camera that has turned and moved a little, from unit vectors (N, 3) to (N, 3).

    Each vector, once turned, may lie anywhere in the plane through itself and the direction of the motion.
    Turn and direction are found alternately, with weights for the least sum of absolute errors, so that
    moving objects do not count. A turn alone that fits most vectors would take one side of a street for a
    turning world.
    """
    left, _, right = np.linalg.svd(after.T @ before)
    turn: Array = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    weights = np.ones(len(before))
    for _ in range(_STEPS):
        turned = before @ turn.T
        normals = np.cross(turned, after)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + _SMALL
        motion = np.linalg.eigh((normals * weights[:, None]).T @ normals)[1][:, 0]
        across = np.cross(motion, turned)
        sines = np.linalg.norm(across, axis=1, keepdims=True)
        across /= np.maximum(sines, _POLE)
        errors = (after * across).sum(axis=1)
        root = np.sqrt(weights)
        small, *_ = np.linalg.lstsq(np.cross(turned, across) * root[:, None], errors * root, rcond=None)
        turn = np.asarray(cv2.Rodrigues(small)[0], np.float64) @ turn
        weights = 1 / np.maximum(np.abs(errors), _EXACT)
    return turn


def _corners(sphere: SphereBand, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(N, 2) corners of the band, each once though the seam is padded."""
    mask = np.zeros_like(image)
    mask[sphere.inner, _PAD:-_PAD] = 255
    found = cv2.goodFeaturesToTrack(image, _CORNERS, 0.005, _DISTANCE, mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)
