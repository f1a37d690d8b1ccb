"""Regions of the lower half that stay the same while the camera moves: the operator, a tripod, a car.

The edges of such things are in the same places in all panoramas; the world's edges move. So the directions of
edges are summed over the panoramas: where they agree, the sum is as long as its parts; where they are
arbitrary, it stays short. Sums take no memory per panorama. Areas without edges are found as the inside of
areas with edges.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.seam import Floats

WIDTH = 1024  # columns of the panoramas; things thinner than a third of a degree are ignored
FEWEST = 6  # panoramas; fewer agree too often by accident
MOST = 200  # panoramas; more change nothing

_RADIUS = WIDTH // 4  # pixels from the nadir to the horizon in the disc
_DEGREE = _RADIUS / 90  # pixels
_NOISE = 6.0  # grey levels per pixel of an edge that counts by half
_AGREE = 0.8  # share of edges that must agree; boards of a floor, along which one walks, reach 0.7
_EDGES = 0.25  # mean strength that makes a place count as one with edges
_SMOOTH = 0.7  # degrees over which edges are averaged
_CLOSE = 3.0  # degrees across which edges belong to one thing
_NADIR = 25.0  # degrees from the nadir within which the thing must reach
_MARGIN = 1.5  # degrees added around it: shadows and what moves a little


@dataclass(frozen=True, eq=False)
class StaticRegion:
    """A region of the lower half of panoramas, as a disc: the nadir in the middle, the horizon around it."""

    disc: NDArray[np.bool_]  # (2 R, 2 R) True = static; R pixels from the nadir to the horizon

    def panorama(self, height: int) -> NDArray[np.bool_]:
        """(height, 2 height) the same in a panorama."""
        v, u = np.mgrid[0:height, 0 : 2 * height] + 0.5
        angle = 90 - (v / height * 180 - 90)  # degrees from the nadir
        azimuth = u / height * np.pi - np.pi
        x = (angle * np.sin(azimuth) * _DEGREE + _RADIUS).astype(np.int64)
        y = (angle * np.cos(azimuth) * _DEGREE + _RADIUS).astype(np.int64)
        last = 2 * _RADIUS - 1
        found: NDArray[np.bool_] = self.disc[y.clip(0, last), x.clip(0, last)] & (angle < 90)
        return found


def static_region(panoramas: Iterable[NDArray[np.uint8]]) -> StaticRegion:
    """What stays the same around the nadir of panoramas (WIDTH / 2, WIDTH, 3) that were taken at many places.

    Args: panoramas, FEWEST or more.
    """
    agreed = np.zeros((2 * _RADIUS, 2 * _RADIUS, 2), np.float32)
    strength = np.zeros((2 * _RADIUS, 2 * _RADIUS), np.float32)
    count, columns, rows = 0, *_where()
    for panorama in panoramas:
        grey = cv2.cvtColor(panorama, cv2.COLOR_RGB2GRAY).astype(np.float32)
        ringed = np.pad(np.pad(grey, ((0, 0), (1, 1)), mode="wrap"), ((1, 1), (0, 0)), mode="edge")
        edges = _edges(np.asarray(cv2.remap(ringed, columns, rows, cv2.INTER_LINEAR), np.float32))
        agreed += edges
        strength += np.hypot(edges[..., 0], edges[..., 1])
        count += 1
    sigma = _SMOOTH * _DEGREE
    total = cv2.GaussianBlur(strength, (0, 0), sigma)
    same = cv2.GaussianBlur(np.hypot(agreed[..., 0], agreed[..., 1]), (0, 0), sigma)
    return StaticRegion(_thing((same > _AGREE * total) & (total > _EDGES * count)))


def _where() -> tuple[Floats, Floats]:
    """Columns and rows (2 R, 2 R) of a panorama with a ring of one pixel, where each pixel of the disc is."""
    y, x = np.mgrid[0 : 2 * _RADIUS, 0 : 2 * _RADIUS] + 0.5 - _RADIUS
    u = (np.arctan2(x, y) / (2 * np.pi) + 0.5) * WIDTH
    v = (180 - np.hypot(x, y) / _DEGREE) / 180 * (WIDTH // 2)
    return (u + 0.5).astype(np.float32), (v + 0.5).astype(np.float32)  # pixel centres and the ring


def _edges(grey: Floats) -> Floats:
    """(h, w, 2) gradient of grey (h, w), 0 where there is none and of length 1 where it is strong."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    across = [cv2.Scharr(smooth, cv2.CV_32F, 1, 0), cv2.Scharr(smooth, cv2.CV_32F, 0, 1)]
    gradient = np.stack(across, axis=-1) / 32  # grey levels per pixel
    length = np.hypot(gradient[..., 0], gradient[..., 1])
    return np.asarray(gradient / (length + _NOISE)[..., None], np.float32)


def _thing(edges: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The one thing around the nadir that has these edges (2 R, 2 R), filled and with a margin."""
    y, x = np.mgrid[0 : 2 * _RADIUS, 0 : 2 * _RADIUS] + 0.5 - _RADIUS
    angle = np.hypot(x, y) / _DEGREE
    closed = cv2.morphologyEx((edges & (angle < 90)).astype(np.uint8), cv2.MORPH_CLOSE, _ball(_CLOSE / 2))
    _, labels = cv2.connectedComponents(closed)
    kept = np.unique(labels[(angle < _NADIR) & (closed > 0)])
    thing = np.isin(labels, kept[kept > 0]).astype(np.uint8)
    outlines, _ = cv2.findContours(thing, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(thing, outlines, -1, 1, cv2.FILLED)
    return np.asarray(cv2.dilate(thing, _ball(_MARGIN)) > 0)


def _ball(degrees: float) -> NDArray[np.uint8]:
    size = 2 * round(degrees * _DEGREE) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)
