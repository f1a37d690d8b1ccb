"""People who walk through a place and one who carries the camera, painted into its panoramas.

Walkers go along the path of the cameras, each at a speed of its own, in clothes of a colour that the place
does not have: so a network of two convolutions can find them, as a trained one finds real people.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from onnx import helper

from panolog.scene.image_files import decode_panorama
from panolog.scene.model import Panorama, Scene
from tests.prepare.networks.networks import given, save

Array = NDArray[np.float64]
WALKERS = 48  # along the whole path
_FINER = 2  # samples for each pixel, along both axes
_SIZE, _SPREAD = 256, 2  # pixels of a view; and around what is found that are masked too


@dataclass(frozen=True, eq=False)
class Person:
    """Where someone stands, and how tall and of which colour."""

    feet: Array  # (2,) metres
    height: float  # metres
    color: Array  # (3,) RGB in [0, 1]


def paint_people(
    scene: Scene, folder: Path, depth: dict[str, NDArray[np.float64]]
) -> dict[int, NDArray[Any]]:
    """Makes `folder` the scene with people in its training panoramas; returns where they are.

    World z is up, 0 the ground, and units are metres. Args: depth, by stem of the panorama (h, 2h) metres.
    Returns for each of `scene.train` (H, W) the share of a pixel that people cover.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "sparse").symlink_to(scene.root / "sparse")
    random = np.random.default_rng(7)
    crowd = _crowd(scene, random)
    where = dict[int, NDArray[Any]]()
    for row, panorama in enumerate(scene.panoramas):
        path = folder / "images" / panorama.image.name
        if row not in scene.train:
            path.symlink_to(panorama.image)
            continue
        image = decode_panorama(panorama.image) / 255
        where[row] = np.zeros(image.shape[:2])
        for person in [*(at[row] for at in crowd), _operator(panorama, row, random)]:
            _paint(image, where[row], panorama, person, depth[panorama.stem])
        pixels = np.rint(image[..., ::-1] * 255).astype(np.uint8)
        cv2.imwrite(str(path), pixels, [cv2.IMWRITE_JPEG_QUALITY, 92])
    return where


def finder(folder: Path) -> Path:
    """A network of views that finds such clothes: less green than red and blue, and what is close to that."""
    contrast = np.array([[1, -1, 0], [0, -1, 1]], np.float32)[..., None, None]
    spread = np.ones((1, 1, 2 * _SPREAD + 1, 2 * _SPREAD + 1), np.float32)
    nodes = [
        helper.make_node("Conv", ["image", "contrast"], ["both"]),
        helper.make_node("ReduceMin", ["both"], ["less"], axes=[1]),
        helper.make_node("Greater", ["less", "enough"], ["sure"]),
        helper.make_node("Cast", ["sure"], ["core"], to=1),
        helper.make_node("Conv", ["core", "spread"], ["people"], pads=[_SPREAD] * 4),
    ]
    manifest = {
        "task": "mask",
        "input": given(_SIZE, width=_SIZE, seam="tiles", fov=90),
        "ignore": {"output": "people", "threshold": 0.5, "above": "ignore"},
    }
    constants = {"contrast": contrast, "enough": np.array(0.09, np.float32), "spread": spread}
    shape: list[int | str] = ["N", 3, _SIZE, _SIZE]
    return save(folder, nodes, ["people"], manifest, shape=shape, constants=constants)


def _crowd(scene: Scene, random: np.random.Generator) -> list[list[Person]]:
    """For each walker, the person at the time of each panorama."""
    path, last = scene.centers[:, :2], len(scene.panoramas) - 1
    along = np.gradient(path, axis=0)
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    crowd = []
    for _ in range(WALKERS):
        start, speed = random.uniform(-0.3, 1.3) * last, random.choice([-1.0, -0.6, 0.3, 0.7, 0.97, 1.3])
        lane = random.choice([-1, 1]) * random.uniform(0.9, 3.5)
        height, color = random.uniform(1.55, 1.9), _color(random)
        times = np.arange(last + 1)
        there = start + speed * (times - start)
        feet = np.stack([np.interp(there, times, path[:, i] + lane * aside[:, i]) for i in (0, 1)], axis=1)
        feet[(there < 0) | (there > last)] = 1e6  # not in the street
        crowd.append([Person(at, height, color) for at in feet])
    return crowd


def _operator(panorama: Panorama, row: int, random: np.random.Generator) -> Person:
    """Who carries the camera overhead; a stabilised picture turns around with respect to them."""
    angle = 0.9 * row + random.uniform(-0.4, 0.4)
    feet = panorama.center[:2] + 0.55 * np.array([np.cos(angle), np.sin(angle)])
    return Person(feet, float(panorama.center[2]) - 0.15, np.array([0.75, 0.12, 0.62]))


def _color(random: np.random.Generator) -> Array:
    return np.array([random.uniform(0.55, 0.95), random.uniform(0.02, 0.2), random.uniform(0.55, 0.95)])


def _paint(image: Array, where: Array, panorama: Panorama, person: Person, depth: Array) -> None:
    """Paints someone onto an upright plane that faces the camera, in front of what is farther away."""
    height, width = image.shape[:2]
    away = person.feet - panorama.center[:2]
    distance = float(np.linalg.norm(away))
    if not 0.3 < distance < 25:
        return
    forward = np.array([*(away / distance), 0.0])
    ahead = panorama.rotation @ forward
    middle = (np.arctan2(ahead[0], ahead[2]) / (2 * np.pi) + 0.5) * width
    half = int(np.ceil(np.arctan(0.45 / distance) / (2 * np.pi) * width)) + 4
    columns = np.arange(int(middle) - half, int(middle) + half + 1)
    fine = (np.arange(len(columns) * _FINER) + 0.5) / _FINER + columns[0]
    azimuth = (fine / width - 0.5) * 2 * np.pi
    elevation = (0.5 - (np.arange(height * _FINER) + 0.5) / (height * _FINER))[:, None] * np.pi
    level = np.cos(elevation)
    rays = np.stack(
        [level * np.sin(azimuth), -np.sin(elevation) + 0 * azimuth, level * np.cos(azimuth)], axis=-1
    )
    rays = rays @ panorama.rotation
    reach = distance / np.maximum(rays @ forward, 1e-6)
    right = np.array([forward[1], -forward[0], 0.0])
    x, y = (rays @ right) * reach, panorama.center[2] + rays[..., 2] * reach
    rows = np.arange(height * _FINER) * len(depth) // (height * _FINER)
    behind = depth[rows][:, (fine / width * depth.shape[1]).astype(int) % depth.shape[1]]
    near = (abs(x) < 0.25 * person.height) & (y > 0) & (y < person.height) & (reach < behind * 1.1 + 0.1)
    light = np.zeros(near.shape)
    light[near] = _body(x[near] / person.height, y[near] / person.height)

    def coarse(values: Array) -> Array:
        return np.asarray(values.reshape(height, _FINER, len(columns), _FINER).mean(axis=(1, 3)))

    share, light = coarse((light > 0).astype(float)), coarse(light)
    at = columns % width
    image[:, at] = image[:, at] * (1 - share)[..., None] + light[..., None] * person.color
    where[:, at] = np.maximum(where[:, at], share)


def _body(x: Array, y: Array) -> Array:
    """The brightness of a body at points of a plane, 0 off it; x and y in heights, from between the feet."""
    cover = np.zeros(x.shape, bool)
    for first, last, radius in _limbs():
        along = last - first
        share = np.clip(((x - first[0]) * along[0] + (y - first[1]) * along[1]) / (along @ along), 0, 1)
        cover |= np.hypot(x - first[0] - share * along[0], y - first[1] - share * along[1]) < radius
    return np.where(cover, np.where(np.sin(y * 70) > 0, 1.0, 0.7) * (0.75 + 0.9 * x), 0.0)


def _limbs() -> Iterator[tuple[Array, Array, float]]:
    """The ends and radius of each part, in heights."""
    for side in (-1, 1):
        yield np.array([side * 0.05, 0.5]), np.array([side * 0.11, 0.03]), 0.055
        yield np.array([side * 0.14, 0.79]), np.array([side * 0.19, 0.45]), 0.035
    yield np.array([0.0, 0.55]), np.array([0.0, 0.76]), 0.11
    yield np.array([0.0, 0.93]), np.array([0.0, 0.94]), 0.06
