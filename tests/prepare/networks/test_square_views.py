"""Views of a panorama: they cover the sphere, show it upright, and lead back to where it was found."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import helper

from panolog.prepare.networks.masks import share_of_sphere
from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.networks.square_views import Tiles
from tests.prepare.networks.networks import CHANNELS, channel, given, save


@pytest.mark.parametrize("fov", [40.0, 61.0, 90.0, 120.0])
def test_views_cover_the_sphere_even_without_their_borders(fov: float) -> None:
    tiles = Tiles(48, fov)
    count = len(tiles.views(np.zeros((tiles.width // 2, tiles.width, 3), np.uint8)))
    assert tiles.joined(np.ones((count, 12, 12), bool)).all()


def test_a_view_shows_what_a_camera_would() -> None:
    """A ball on the horizon, to the right of the middle, is a circle there, as far as it should be."""
    tiles = Tiles(128, 90)
    panorama = np.zeros((tiles.width // 2, tiles.width, 3), np.uint8)
    azimuth = np.radians(20)
    column = round((azimuth / (2 * np.pi) + 0.5) * tiles.width)
    cv2.circle(panorama, (column, tiles.width // 4 - 20), 4, (255, 255, 255), -1)
    level = sum(row.count for row in tiles.rows if row.pitch < -0.01)
    rows, columns = np.nonzero(tiles.views(panorama)[level][..., 0] > 128)
    elevation = 20 / (tiles.width // 2) * np.pi
    assert columns.mean() == pytest.approx(64 + 64 * np.tan(azimuth), abs=1)
    assert rows.mean() == pytest.approx(64 - 64 * np.tan(elevation) / np.cos(azimuth), abs=1)


def spots(width: int, radius: float) -> NDArray[np.bool_]:
    """A spot on the seam, one almost straight down and others, as a panorama (width / 2, width)."""
    v, u = np.mgrid[0 : width // 2, 0:width] + 0.5
    elevation, azimuth = np.pi / 2 - v / width * 2 * np.pi, (u / width - 0.5) * 2 * np.pi
    level = np.cos(elevation)
    rays = np.stack([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    centers = np.array([(0, 0, -1), (0.2, -0.97, 0.1), (0.7, 0.1, 0.7), (-0.6, -0.8, 0), (0, 1, 0.1)])
    centers /= np.linalg.norm(centers, axis=1)[:, None]
    return np.asarray((np.einsum("kc,chw->khw", centers, rays) > np.cos(radius)).any(axis=0))


@pytest.mark.parametrize("scale", [1, 4])
def test_a_network_of_views_finds_what_is_red_where_it_is(tmp_path: Path, scale: int) -> None:
    """Also across the seam, at the poles, and by an output that is smaller than the view."""
    size = 64 * scale
    pool = helper.make_node("AveragePool", ["red"], ["found"], kernel_shape=[scale] * 2, strides=[scale] * 2)
    manifest = {
        "task": "mask",
        "input": given(size, width=size, seam="tiles", fov=90),
        "ignore": {"output": "found", "threshold": 0.5, "above": "ignore"},
    }
    shape: list[int | str] = ["N", 3, size, size]
    nodes = [channel(0, "red"), pool]
    network = MoverNetwork(save(tmp_path, nodes, ["found"], manifest, shape=shape, constants=CHANNELS))
    wanted, near = spots(network.width, 0.15), spots(network.width, 0.19)
    found = network.find(np.where(wanted[..., None], [255, 0, 0], [0, 255, 255]).astype(np.uint8))
    assert share_of_sphere(wanted & ~found) < 0.05 * share_of_sphere(wanted)
    assert not (found & ~near).any()
