"""A small town as a run sees it: cameras along its streets, points on its houses, photographs and renders."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from panolog.partition.bounds import aabb
from panolog.partition.cells import Grid
from panolog.partition.contraction import contract
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply
from panolog.synthetic.layout import camera_path, sun, town
from panolog.synthetic.light import shade
from panolog.synthetic.trace import PanoramaRays, Sun, cast

_WIDTH, _PHOTOGRAPHS = 512, 6  # pixels of a panorama, and how many differ
_STREETS = (
    (-60.0, -14.0, 60.0, -14.0),
    (-60.0, 16.0, 60.0, 16.0),
    (-22.0, -40.0, -22.0, 40.0),
    (24.0, -40.0, 24.0, 40.0),
)


@cache
def _photographs() -> list[NDArray[np.uint8]]:
    """(H, W, 3) BGR each: panoramas of the synthetic town."""
    shapes = town(0)
    light = Sun.over(shapes, sun(), texel=0.3)
    pictures = []
    for rotation, center in zip(*camera_path(_PHOTOGRAPHS, 0), strict=True):
        rays = PanoramaRays(rotation, center, _WIDTH, 1)
        color = shade(shapes, rays, cast(shapes, rays), light)
        image = np.rint(255 * color.reshape(3, _WIDTH // 2, _WIDTH)).astype(np.uint8)
        pictures.append(np.ascontiguousarray(image[::-1].transpose(1, 2, 0)))
    return pictures


def write_picture(path: Path, index: int, share: float) -> None:
    """Writes a JPEG of a render above its photograph: the more `share` of the training, the sharper."""
    truth = _photographs()[index % _PHOTOGRAPHS]
    render = cv2.GaussianBlur(truth, (0, 0), 0.6 + 9 * (1 - share) ** 2)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.concatenate([render, truth]), [cv2.IMWRITE_JPEG_QUALITY, 85])


def write_path(path: Path) -> None:
    """Writes a PNG of the cameras from above."""
    picture = np.full((420, 560, 3), 255, np.uint8)
    for x, y, _ in cameras(64):
        cv2.circle(picture, (round(280 + 4 * x), round(210 - 4 * y)), 3, (160, 90, 30), -1, cv2.LINE_AA)
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), picture)


def write_scene(root: Path, name: str) -> None:
    """Writes as much of a scene as it takes to show one of its panoramas."""
    for folder in (root / "sparse" / "0", root / "images"):
        folder.mkdir(parents=True)
    (root / "sparse" / "0" / "cameras.txt").touch()
    cv2.imwrite(str(root / "images" / name), _photographs()[2])


def cameras(count: int) -> NDArray[np.float64]:
    """(count, 3) centres along two streets and two lanes, in metres."""
    random = np.random.default_rng(1)
    streets = np.array(_STREETS)
    street = np.arange(count) % len(streets)
    along = (np.arange(count) // len(streets) + 0.5) / (count / len(streets))
    ends = streets[street].reshape(count, 2, 2)
    places = ends[:, 0] + along[:, None] * (ends[:, 1] - ends[:, 0])
    return np.column_stack([places + random.normal(0, 0.8, (count, 2)), random.normal(1.7, 0.1, count)])


def points(count: int = 12_000) -> NDArray[np.float64]:
    """(count, 3) on the walls and roofs of houses along the streets, in metres."""
    random = np.random.default_rng(2)
    corners = random.uniform([-66, -46], [60, 40], (90, 2))
    sizes = random.uniform(6, 15, (90, 2))
    house = random.integers(0, 90, count)
    inside = random.uniform(0, 1, (count, 2))
    wall = random.random(count) < 0.7
    side = random.integers(0, 2, count)
    inside[wall, side[wall]] = np.round(inside[wall, side[wall]])
    places = corners[house] + inside * sizes[house] + random.normal(0, 0.15, (count, 2))
    far = random.random(count) < 0.15  # the land around
    places[far] += random.normal(0, 70, (int(far.sum()), 2))
    return np.column_stack([places, random.uniform(0, 8, count)])


def write_model(path: Path, sky: int = 500) -> None:
    """Writes a PLY with Gaussians at the points, and a sky."""
    means = torch.from_numpy(points()).float()
    dome = torch.nn.functional.normalize(
        torch.randn(sky, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    means = torch.cat([means, 400 * dome])
    n = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    scales, shs = torch.full((n, 3), -2.0), (torch.zeros(n, 1, 3), torch.zeros(n, 15, 3))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, Gaussians(means, quats, scales, torch.zeros(n), *shs, sky=sky))


def plan(grid: str, count: int) -> Plan:
    """A partition of the town for that many training cameras: scores fall with the distance to a block."""
    cells, centers, where = Grid.parse(grid), cameras(count), points()
    block = cells.block_of(contract(where, aabb(centers, PartitionConfig().rho_tri)))
    distance = np.linalg.norm(centers[:, None] - where[::10], axis=2)  # (K, P / 10)
    seen = np.exp(-distance / 50) @ np.eye(cells.count)[block[::10]]
    scores = seen / seen.max() * np.random.default_rng(3).uniform(0.7, 1, seen.shape)
    names = [f"street_{row:03d}.jpg" for row in range(count)]
    return make_plan(centers, where, scores, cells, PartitionConfig(), rows=range(count), names=names)
