"""A scene with passers-by: figures are drawn into some of its training panoramas, nothing else changes.

Some walk past a single panorama, others through a few that follow each other. Figures are in the depth maps
and in front of the sky too, as an estimator would see them. Held-out panoramas stay without them.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.movers.figures import Figure, Picture, Standpoint, draw
from panolog.scene.depth_alignment import Alignment, AlignmentError, align_depth
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic_folder, write_bytes
from panolog.scene.image_files import decode, decode_panorama
from panolog.scene.images import View, load_view
from panolog.scene.model import Panorama, Scene
from panolog.scene.random_streams import generator

Array = NDArray[np.float64]
FIGURES = "figures"  # folder of a made scene: where figures are, 255 = figure or shadow
GROUP = 3  # panoramas that follow each other which a walker is seen in
PEOPLE = (2, 6)  # figures in a panorama, least and most
NEAR, FAR = 0.9, 4.0  # distance of figures, in heights of the camera
WALKS = 0.6  # heights of the camera from one panorama to the next
TRIES = 60  # places that are looked at for each figure
_FREE = 0.97  # share of a figure's pixels that must be in front of the place
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground below the cameras."""

    up: Array  # (3,)
    eyes: Array  # (K,) heights of the cameras above it, world units


@dataclass(eq=False)
class Walker:
    """A figure at a place."""

    figure: Figure
    feet: Array  # (3,) world units; only what is horizontal of it counts
    step: Array  # (3,) to where it is in the next panorama


def paste(scene: Scene, output: Path, share: float, seed: int) -> dict[str, float]:
    """Writes `output`, the scene with figures in that share of its training panoramas.

    Returns the share of its pixels that figures and their shadows cover, by name of the panorama. Raises
    SceneError if `output` exists or the scene has no layer of points below its cameras.
    """
    if output.exists():
        raise SceneError(f"{output}: already exists; give a new folder")
    ground = find_ground(scene)
    covered: dict[str, float] = {}
    with atomic_folder(output) as folder:
        _links(scene, folder)
        for row, walkers in _crowds(scene, ground, share, seed):
            covered[scene.panoramas[row].name] = _write(scene, folder, row, ground, walkers)
        write_bytes(folder / FIGURES / "covered.json", json.dumps(covered, indent=2).encode())
    return covered


def find_ground(scene: Scene) -> Ground:
    """Where people stand. Raises SceneError if no points are below the cameras."""
    up: Array = -np.mean([panorama.rotation[1] for panorama in scene.panoramas], axis=0)
    up /= np.linalg.norm(up)
    heights, lifted = scene.points @ up, scene.centers @ up
    points, centers = (them - (them @ up)[:, None] * up for them in (scene.points, scene.centers))
    eyes = []
    for center, top in zip(centers, lifted, strict=True):
        nearest = np.argsort(np.linalg.norm(points - center, axis=1), kind="stable")[:100]
        eyes.append(top - np.percentile(heights[nearest], 10))
    if min(eyes) <= 0:
        raise SceneError(f"{scene.root}: a camera is below all points around it; figures need a ground")
    return Ground(up, np.array(eyes))


def chosen(train: tuple[int, ...], share: float, random: np.random.Generator) -> list[list[int]]:
    """Groups of rows that are to have figures, in all `share` of `train`: half of them alone."""
    wanted = max(1, round(share * len(train)))
    groups, taken = [], set[int]()
    for most in [GROUP] * (wanted // 2 // GROUP) + [1] * wanted:
        if not (size := min(most, wanted - len(taken))):
            break
        around = [train[max(0, i - 1) : i + size + 1] for i in range(len(train) - size + 1)]
        if starts := [i for i, rows in enumerate(around) if taken.isdisjoint(rows)]:
            begin = int(random.choice(starts))
            groups.append(list(train[begin : begin + size]))
            taken.update(groups[-1])
    return sorted(groups)


def _crowds(scene: Scene, ground: Ground, share: float, seed: int) -> Iterator[tuple[int, list[Walker]]]:
    """The panoramas with figures, and those."""
    groups = chosen(scene.train, share, generator(seed, "movers", "panoramas", 0))
    for group in groups:
        walkers: list[Walker] = []
        for row in group:
            random = generator(seed, "movers", "figures", row)
            walkers = [Walker(w.figure, w.feet + w.step, w.step) for w in walkers]
            alignment, view = _depth(scene, row)
            walkers = [w for w in walkers if _free(scene, row, ground, w, alignment, view)]
            for _ in range(int(random.integers(PEOPLE[0], PEOPLE[1] + 1)) - len(walkers)):
                walkers += _someone(scene, row, ground, random, alignment, view)
            yield row, walkers


def _depth(scene: Scene, row: int) -> tuple[Alignment | None, View]:
    view = load_view(scene.panoramas[row], row, scene.width)
    try:
        return (None if view.inverse_depth is None else align_depth(scene, view, 0)), view
    except AlignmentError:
        return None, view


def _someone(
    scene: Scene,
    row: int,
    ground: Ground,
    random: np.random.Generator,
    alignment: Alignment | None,
    view: View,
) -> list[Walker]:
    """A new figure near a panorama; none where there is no room."""
    eye = float(ground.eyes[row])
    east = np.cross(ground.up, np.eye(3)[int(np.abs(ground.up).argmin())])
    east /= np.linalg.norm(east)
    level = np.stack([east, np.cross(ground.up, east)])
    for _ in range(TRIES):
        azimuth, heading = random.uniform(0, 2 * np.pi, 2)
        distance = eye * random.uniform(NEAR, FAR)
        feet = scene.centers[row] + distance * np.array([np.cos(azimuth), np.sin(azimuth)]) @ level
        step = WALKS * eye * np.array([np.cos(heading), np.sin(heading)]) @ level
        walker = Walker(Figure.drawn(random, eye), feet, step)
        if _free(scene, row, ground, walker, alignment, view):
            return [walker]
    return []


def _standpoint(panorama: Panorama, ground: Ground, eye: float, feet: Array) -> Standpoint:
    away = feet - panorama.center
    away = away - (away @ ground.up) * ground.up
    distance = float(np.linalg.norm(away))
    forward = away / max(distance, 1e-9)
    axes = np.stack([np.cross(forward, ground.up), ground.up, forward])
    return Standpoint(axes @ panorama.rotation.T, eye, distance)


def _picture(scene: Scene, row: int, ground: Ground, walker: Walker, width: int) -> Picture:
    at = _standpoint(scene.panoramas[row], ground, float(ground.eyes[row]), walker.feet)
    return draw(walker.figure, at, width)


def _free(
    scene: Scene, row: int, ground: Ground, walker: Walker, alignment: Alignment | None, view: View
) -> bool:
    """Whether a figure is near enough to be seen, not in the camera, and in front of what is there."""
    at = _standpoint(scene.panoramas[row], ground, float(ground.eyes[row]), walker.feet)
    if not 0.7 * NEAR < at.distance / at.eye < 2 * FAR:
        return False
    if alignment is None or view.inverse_depth is None:
        return True
    small = 256
    picture = draw(walker.figure, at, small)
    body = picture.cover > 0.5
    prior = torch.nn.functional.adaptive_avg_pool2d(view.inverse_depth[None], (small // 2, small))[0]
    inverse = alignment.scale * prior.numpy() + alignment.offset
    in_front = inverse[body] < 1 / picture.distance[body]
    return bool(body.any()) and float(in_front.mean()) >= _FREE


def _write(scene: Scene, folder: Path, row: int, ground: Ground, walkers: list[Walker]) -> float:
    """Replaces the files of one panorama by those with figures; returns what share these cover."""
    panorama, width = scene.panoramas[row], scene.width
    image = decode_panorama(panorama.image).astype(np.float64) / 255
    shown = np.zeros(image.shape[:2], bool)
    ordered = sorted(walkers, key=lambda w: -float(np.linalg.norm(w.feet - panorama.center)))
    for walker in ordered:
        it = _picture(scene, row, ground, walker, width)
        image = image * (it.light * (1 - it.cover))[..., None] + it.color
        shown |= (it.cover > 0.1) | (it.light < 0.9)
    pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)[..., ::-1]
    _replace(_image(scene, folder, panorama), pixels)
    write_bytes(folder / FIGURES / f"{panorama.stem}.png", _encoded(".png", shown.astype(np.uint8) * 255))
    if panorama.sky_mask is not None:
        _layer(scene, folder, row, ground, ordered, panorama.sky_mask, None)
    if panorama.depth is not None and (alignment := _depth(scene, row)[0]) is not None:
        _layer(scene, folder, row, ground, ordered, panorama.depth, alignment)
    return float(shown.mean())


def _layer(
    scene: Scene,
    folder: Path,
    row: int,
    ground: Ground,
    walkers: list[Walker],
    file: Path,
    alignment: Alignment | None,
) -> None:
    """A sky mask, or with an alignment a depth map, with the figures."""
    layer = decode(file, cv2.IMREAD_UNCHANGED)
    for walker in walkers:
        it = _picture(scene, row, ground, walker, layer.shape[1])
        body = it.cover > 0.5
        if alignment is None:
            layer[body] = 255
        else:
            prior = (1 / it.distance[body] - alignment.offset) / alignment.scale
            layer[body] = np.clip(np.rint(prior * 65535), 1, 65535).astype(layer.dtype)
    _replace(folder / file.relative_to(scene.root), layer)


def _image(scene: Scene, folder: Path, panorama: Panorama) -> Path:
    return folder / panorama.image.relative_to(scene.root)


def _encoded(suffix: str, pixels: NDArray[np.integer[Any]]) -> bytes:
    return bytes(cv2.imencode(suffix, pixels, _QUALITY if suffix in (".jpg", ".jpeg") else [])[1])


def _replace(path: Path, pixels: NDArray[np.integer[Any]]) -> None:
    """Writes a picture in place of a link."""
    path.unlink()
    write_bytes(path, _encoded(path.suffix.lower(), pixels))


def _links(scene: Scene, folder: Path) -> None:
    """A folder of the scene's form whose files are links."""
    (folder / FIGURES).mkdir()
    for path in sorted(scene.root.rglob("*")):
        copy = folder / path.relative_to(scene.root)
        if path.is_dir():
            copy.mkdir(exist_ok=True)
        else:
            copy.symlink_to(path.resolve())
