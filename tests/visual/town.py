"""A small town as a run sees it: cameras along its streets, points on its houses, photographs and renders."""

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array

from panolog.partition.cells import Grid
from panolog.partition.contraction import contract
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply


def photograph(index: int) -> NDArray[np.uint8]:
    """(256, 512, 3) BGR: patches of colour, other ones for each index."""
    patches = np.random.default_rng(index).integers(0, 256, (8, 16, 3), np.uint8)
    return np.asarray(cv2.resize(patches, (512, 256), interpolation=cv2.INTER_CUBIC), np.uint8)


def write_picture(path: Path, index: int, share: float) -> None:
    """Writes a JPEG of a render above its photograph: the more `share` of the training, the sharper."""
    truth = photograph(index)
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
    cv2.imwrite(str(root / "images" / name), photograph(2))


def cameras(count: int) -> NDArray[np.float64]:
    """(count, 3) centres in turn along two streets and a lane across, in metres."""
    along, way = np.linspace(-60, 60, count), np.arange(count) % 3
    y = np.where(way == 2, along * 2 / 3, np.where(way == 1, 16, -14))
    places = np.column_stack([np.where(way == 2, 24, along), y, np.full(count, 1.7)])
    return places + np.random.default_rng(1).normal(0, [0.8, 0.8, 0.1], (count, 3))


def points(count: int = 12_000) -> NDArray[np.float64]:
    """(count, 3) in houses, and some in the land around, in metres."""
    random = np.random.default_rng(2)
    houses = random.uniform([-66, -46], [60, 40], (90, 2))
    places = houses[random.integers(0, 90, count)] + random.uniform(-4, 4, (count, 2))
    places[::7] += random.normal(0, 70, places[::7].shape)
    return np.column_stack([places, random.uniform(0, 8, count)])


def write_model(path: Path) -> None:
    """Writes a PLY with Gaussians at the points."""
    means = torch.from_numpy(points()).float()
    n = len(means)
    quats, scales = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), torch.full((n, 3), -2.0)
    colours = torch.zeros(n, 1, 3), torch.zeros(n, 15, 3)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, Gaussians(means, quats, scales, torch.zeros(n), *colours, sky=0))


def plan(grid: str, count: int) -> tuple[Plan, csr_array]:
    """A partition of the town for that many cameras, and its scores, which fall with the distance."""
    cells, centers, where = Grid.parse(grid), cameras(count), points()
    config = PartitionConfig(aspect=0.5)
    block = cells.block_of(contract(where, config.box(centers)))
    distance = np.linalg.norm(centers[:, None] - where[::10], axis=2)  # (K, P / 10)
    seen = np.exp(-distance / 50) @ np.eye(cells.count)[block[::10]]
    scores = csr_array(seen / seen.max() * np.random.default_rng(3).uniform(0.7, 1, seen.shape))
    names = [f"street_{row:03d}.jpg" for row in range(count)]
    return make_plan(centers, where, scores, cells, config, rows=range(count), names=names), scores
