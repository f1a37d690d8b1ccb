"""Small 360° videos of a street whose houses are the same distance away all along, with known poses."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
WIDTH, HEIGHT = 512, 256
SIDE, UP, DOWN, END = 4.0, 6.0, 1.7, 200.0  # metres from the camera to the walls of the street
_TEXEL = 0.06  # metres
_TEXTURE = 1024


@dataclass(frozen=True)
class Shot:
    """Where the camera is in a frame, and what is wrong with it."""

    along: float  # metres along the street
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees of yaw, pitch, roll
    blur: float = 0.0  # pixels of sigma along the horizon
    mover: float | None = None  # degrees of longitude where a large patch is that moves by itself


def walk(lengths: Iterable[float], *, start: float = 0.0) -> list[Shot]:
    """Shots after steps of these lengths in metres, the camera swaying as if carried."""
    along = start + np.cumsum(np.array(list(lengths)))
    sway = np.random.default_rng(3).normal(0, 1, (len(along), 3)).cumsum(axis=0) * (0.6, 0.4, 0.4)
    return [Shot(float(z), (float(a), float(b), float(c))) for z, (a, b, c) in zip(along, sway, strict=True)]


def turn(shot: Shot, degrees: Iterable[float]) -> list[Shot]:
    """The same place while the camera turns, to these angles beyond, with a wobble in pitch and roll."""
    yaw, pitch, roll = shot.turn
    return [
        Shot(shot.along, (yaw + it, pitch + 8 * np.sin(it / 15), roll + 8 * np.sin(it / 25)))
        for it in degrees
    ]


def render(shot: Shot, width: int = WIDTH, *, bearer: bool = True) -> Image:
    """(width / 2, width, 3) BGR of a shot; who bears the camera covers its nadir and moves with it."""
    rays, local = _rays(width, shot.turn)
    position = np.array([0.0, 0.0, shot.along])
    prefetch, behind = np.array([SIDE, DOWN, END]), np.array([-SIDE, -UP, -END])
    with np.errstate(divide="ignore"):
        distance = np.where(rays > 0, prefetch / rays, behind / rays)
    nearest = distance.argmin(axis=1)
    points = position + rays * distance.min(axis=1)[:, None]
    first = np.where(nearest == 0, points[:, 1], points[:, 0])
    second = np.where(nearest == 2, points[:, 1], points[:, 2])
    salt = 331.0 * nearest + 97.0 * (rays[np.arange(len(rays)), nearest] > 0)
    image = _sample(first / _TEXEL + salt, second / _TEXEL, width)
    if bearer:
        below = (local[:, 1] > np.sin(np.deg2rad(50))).reshape(image.shape[:2])
        image[below] = _sample(local[:, 0] * 200, local[:, 2] * 200, width)[below]
    if shot.mover is not None:
        _paste(image, shot.mover)
    if shot.blur:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigmaX=shot.blur, sigmaY=0.4), np.uint8)
    return image


def write_video(path: Path, images: Sequence[Image], *, fourcc: str = "MJPG", fps: float = 30.0) -> Path:
    """The frames (H, W, 3) BGR as a video in the container of the suffix."""
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), fps, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return path


@cache
def tour() -> list[Shot]:
    """Slowly, fast, standing, turning on the spot, on again; every third frame of a walk is blurred."""
    slow, fast = walk([0.06] * 30), walk([0.2] * 15, start=1.8)
    standing = [replace(fast[-1], turn=(it % 3 * 0.2, 0.0, 0.0)) for it in range(15)]
    turning = turn(fast[-1], np.arange(0.0, 200.0, 8.0))
    last = walk([0.12] * 25, start=4.8)
    end = turning[-1].turn[0]
    last = [replace(it, turn=(it.turn[0] + end, *it.turn[1:])) for it in last]
    shots = [*slow, *fast, *standing, *turning, *last]
    moving = {*range(45), *range(85, 110)}
    return [replace(it, blur=2.5) if n % 3 == 1 and n in moving else it for n, it in enumerate(shots)]


def tour_images(*span: int) -> list[Image]:
    """Frames of the tour (H, W, 3) BGR, all of them or those of `range(*span)`."""
    return [_tour_image(number) for number in (range(*span) if span else range(len(tour())))]


@cache
def _tour_image(number: int) -> Image:
    return render(tour()[number])


def short_video(path: Path) -> Path:
    """Eight frames of the tour in which the camera moves."""
    return write_video(path, tour_images(30, 45, 2))


def numbers(files: Sequence[Path]) -> list[int]:
    """Which frames of a video files of `extract_frames` are."""
    return [int(file.stem.rpartition("_")[2]) for file in files]


def _rays(width: int, turned: tuple[float, float, float]) -> tuple[Array, Array]:
    """Directions (N, 3) of all pixels in the world, and in the camera: x right, y down, z forward."""
    local = _grid(width)
    rotation = Rotation.from_euler("YXZ", turned, degrees=True).as_matrix()
    return local @ rotation.T, local


@cache
def _grid(width: int) -> Array:
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(width // 2) + 0.5) / (width // 2) - 0.5) * np.pi
    lon, lat = np.meshgrid(longitude, latitude)
    return np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], axis=-1).reshape(
        -1, 3
    )


@cache
def _texture() -> Image:
    """Patches of several sizes in random colours, without a seam."""
    random = np.random.default_rng(0)
    total = np.zeros((_TEXTURE, _TEXTURE, 3), np.float32)
    for size, weight in ((4, 40), (16, 60), (64, 60)):
        coarse = random.normal(0, weight, (_TEXTURE // size, _TEXTURE // size, 3)).astype(np.float32)
        total += np.repeat(np.repeat(coarse, size, axis=0), size, axis=1)
    return np.clip(cv2.GaussianBlur(total + 120, (0, 0), 1.0), 0, 255).astype(np.uint8)


def _sample(u: Array, v: Array, width: int) -> Image:
    """(width / 2, width, 3) of the texture at texels (N,), repeated for ever."""
    shape = (width // 2, width)
    columns, rows = ((it % _TEXTURE).astype(np.float32).reshape(shape) for it in (u, v))
    sampled = cv2.remap(_texture(), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(sampled, np.uint8)


def _paste(image: Image, longitude: float) -> None:
    """A patch of a quarter of the horizon, as of a bus that passes by."""
    height, width = image.shape[:2]
    columns = (np.arange(width // 4) + round(longitude / 360 * width)) % width
    rows = slice(height // 3, 2 * height // 3)
    image[rows, columns] = _texture()[500 : 500 + rows.stop - rows.start, 300 : 300 + width // 4]
