"""Writes a synthetic place as a COLMAP scene: panoramas, sky masks, depth maps and a sparse model."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import write_colmap
from panolog.scene.errors import ConfigError
from panolog.scene.files import write_bytes
from panolog.scene.write import Progress, no_progress
from panolog.synthetic.city import OVER_TOWERS, city, drive, plan
from panolog.synthetic.district import PITCH, district, flight_path
from panolog.synthetic.layout import camera_path, sun, town
from panolog.synthetic.light import shade
from panolog.synthetic.noise import Floats
from panolog.synthetic.sparse import FAR, SurfaceSample, concatenate_samples, sample_surfaces, visible_rows
from panolog.synthetic.trace import CitySun, PanoramaRays, Scenery, Sun

SAMPLES = 3  # rays per pixel, each way
DENSITY = 250  # points of a city's sparse cloud for each panorama
_STEP = 1.5  # of the median step: neighbours that are farther apart have none between them


@dataclass(frozen=True, eq=False)
class Place:
    """Solids, and where panoramas of them are taken."""

    scenery: Scenery
    sun: Sun | CitySun
    rotations: NDArray[np.float64]  # (K, 3, 3) world-to-camera
    centers: NDArray[np.float64]  # (K, 3) metres
    name: str  # with which the names of its images begin
    far: float = FAR  # metres from which on no points of the cloud are seen
    smallest: float = 0.0  # share of a pixel; shapes that look smaller are left out of a panorama
    held_out: int = 0  # how many panoramas, the last ones, are the test split and no part of the cloud

    @property
    def training(self) -> int:
        """How many panoramas, the first ones, train and make the cloud."""
        return len(self.centers) - self.held_out

    def with_between(self) -> "Place":
        """The place with panoramas half-way between neighbours on its path, which are held out."""
        ways = np.diff(self.centers, axis=0)
        steps = np.linalg.norm(ways, axis=1)
        near = np.flatnonzero(steps < _STEP * np.median(steps))
        rotations = np.concatenate([self.rotations, self.rotations[near]])
        centers = np.concatenate([self.centers, self.centers[near] + ways[near] / 2])
        return replace(self, rotations=rotations, centers=centers, held_out=len(near))


@dataclass(frozen=True, eq=False)
class _Shoot:
    """What all panoramas of a place share."""

    folder: Path
    place: Place
    width: int
    samples: int  # points that each panorama samples for the sparse cloud
    seed: int

    @property
    def smallest(self) -> float:
        """Radians across of the smallest shapes in a panorama."""
        return self.place.smallest * 2 * np.pi / self.width

    def image(self, index: int) -> str:
        """The name of an image."""
        digits = max(3, len(str(len(self.place.centers) - 1)))
        return f"{self.place.name}_{index:0{digits}d}.png"


def make_town(
    folder: Path,
    *,
    panoramas: int = 28,
    width: int = 512,
    points: int = 8000,
    seed: int = 0,
    between: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Ray-casts a small town, seen on a walk along its street; arguments and errors as `make_place`."""
    _check(panoramas, width)
    place = Place(*_lit_town(seed), *camera_path(panoramas, seed), "street")
    return make_place(
        folder, place, width=width, points=points, seed=seed, between=between, progress=progress
    )


@lru_cache(maxsize=1)  # the shadows take longer than the panoramas of a small trial or test
def _lit_town(seed: int) -> tuple[Scenery, Sun]:
    shapes = town(seed)
    return Scenery(shapes), Sun.over(shapes, sun())


def make_flight(
    folder: Path,
    *,
    blocks: tuple[int, int] = (6, 6),
    panoramas: int = 96,
    width: int = 512,
    points: int = 30_000,
    seed: int = 0,
    between: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Ray-casts a district of so many blocks along x and y, seen on a flight over it.

    Other arguments and errors as `make_place`.
    """
    _check(panoramas, width)
    if min(blocks) < 1:
        raise ConfigError(f"a district of {blocks[0]} x {blocks[1]} blocks is not possible: give 1 or more")
    reach = 0.5 * PITCH * float(np.hypot(*blocks)) + PITCH
    shapes = district(*blocks, seed)
    light = Sun.over(shapes, sun(), reach, 0.25)
    place = Place(Scenery(shapes), light, *flight_path(*blocks, panoramas, seed), "flight")
    return make_place(
        folder, place, width=width, points=points, seed=seed, between=between, progress=progress
    )


def make_city(
    folder: Path,
    *,
    panoramas: int = 300,
    flight: bool = False,
    width: int = 512,
    points: int | None = None,
    seed: int = 0,
    between: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Ray-casts a city, as large as so many panoramas on a drive along all of its streets take.

    Args: flight, whether a quarter of the panoramas fly over it instead; points, `DENSITY` of each panorama
    unless given. Other arguments and errors as `make_place`.
    """
    _check(panoramas, width)
    flying = panoramas // 4 if flight else 0
    streets = plan(panoramas - flying)
    paths = [drive(streets, panoramas - flying, seed)]
    if flying:
        columns, rows = streets.cells.shape
        rotations, centers = flight_path(columns, rows, flying, seed)
        paths.append((rotations, centers + np.array([*streets.middle, OVER_TOWERS])))
    rotations, centers = (np.concatenate(parts) for parts in zip(*paths, strict=True))
    scenery = Scenery(city(streets, seed))
    light = CitySun(scenery, sun(), np.array([*streets.middle, 0.0]), streets.reach)
    place = Place(scenery, light, rotations, centers, "city", far=60.0, smallest=0.5)
    count = DENSITY * panoramas if points is None else points
    return make_place(folder, place, width=width, points=count, seed=seed, between=between, progress=progress)


def _check(panoramas: int, width: int) -> None:
    if panoramas < 2:
        raise ConfigError(f"a scene of {panoramas} panoramas cannot be reconstructed: give 2 or more")
    if width < 32 or width % 4:
        raise ConfigError(f"a width of {width} is not possible: give a multiple of 4, at least 32")


def make_place(
    folder: Path,
    place: Place,
    *,
    width: int,
    points: int,
    seed: int,
    between: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Ray-casts a place and writes it as a COLMAP scene; returns `folder`.

    The scene has `images/*.png`, `sparse/0/*.bin` (exact poses, metres, z up; tracks without outliers),
    `skymasks/*.png` (255 foreground, 0 sky) and `depths/*.png` (half as wide; 16 bit, radial inverse depth
    through an affine that differs from image to image, 0 in the sky). Equal arguments write equal bytes.

    Args:
        folder: made if missing.
        place: with at least 2 panoramas.
        width: of the panoramas in pixels, a multiple of 4; they are half as high.
        points: of the sparse cloud; fewer where too few are seen twice.
        seed: of the cloud and the depth maps.
        between: whether panoramas half-way between neighbours are added and held out (`test.txt`), so that
            all others train: far more, and farther from what trains, than every 8th.
        progress: called first with 0, then after each panorama, in order: how many are done, and of how many.
            Each counts twice: its picture, and what it sees of the sparse cloud.

    Raises ConfigError: too few panoramas, or a width that cannot be; OSError: `folder` cannot be written.
    """
    place = place.with_between() if between else place
    panoramas = len(place.centers)
    for part in ("images", "depths", "skymasks"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    shoot = _Shoot(folder, place, width, 2 * points // place.training + 1, seed)
    samples: list[SurfaceSample] = []
    rows: list[NDArray[np.int64]] = []
    progress(0, 2 * panoramas)
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for done, sample in enumerate(pool.map(partial(_panorama, shoot), range(panoramas)), start=1):
            samples.append(sample)
            progress(done, 2 * panoramas)
        cloud = concatenate_samples(samples[: place.training])
        for seen in pool.map(
            partial(visible_rows, place.scenery, cloud.points, far=place.far), place.centers
        ):
            rows.append(seen)
            progress(panoramas + len(rows), 2 * panoramas)
    if place.held_out:
        test = [shoot.image(row).removesuffix(".png") for row in range(place.training, panoramas)]
        write_bytes(folder / "test.txt", "".join(f"{stem}\n" for stem in test).encode())
    _write_model(shoot, cloud, rows, points)
    return folder


def _panorama(shoot: _Shoot, index: int) -> SurfaceSample:
    """Renders and writes one panorama with its sky mask and depth map; samples points for the cloud."""
    place = shoot.place
    rays = PanoramaRays(place.rotations[index], place.centers[index], shoot.width, SAMPLES)
    hits = place.scenery.cast(rays, shoot.smallest)
    color = shade(place.scenery.shapes, rays, hits, place.sun)
    parts = (shoot.width // 2, SAMPLES, shoot.width, SAMPLES)
    # Averaged as displayed, not as light: that is how splatting blends, and so what a model can reach.
    image = np.rint(255 * color.reshape(3, *parts).mean(axis=(2, 4))).astype(np.uint8).transpose(1, 2, 0)
    scenery = np.isfinite(hits.distance).reshape(parts).mean(axis=(1, 3)) >= 0.5
    _write_png(shoot.folder / "images" / shoot.image(index), image[:, :, ::-1])
    _write_png(shoot.folder / "skymasks" / shoot.image(index), np.where(scenery, 255, 0).astype(np.uint8))
    met = np.unique(hits.shape[hits.shape >= 0]).astype(np.int64) if place.smallest else None
    _write_png(shoot.folder / "depths" / shoot.image(index), _depth_map(shoot, index, met))
    random = np.random.default_rng([shoot.seed, 3, index])
    return sample_surfaces(rays, hits, color, shoot.samples, random, place.far)


def _depth_map(shoot: _Shoot, index: int, among: NDArray[np.int64] | None) -> NDArray[np.uint16]:
    """(H/2, W/2) inverse radial depth as a monocular estimator gives it: of unknown scale and offset.

    Args: among, of which shapes; None = of all.
    """
    rays = PanoramaRays(shoot.place.rotations[index], shoot.place.centers[index], shoot.width // 2, 1)
    inverse = 1 / shoot.place.scenery.cast(rays, among=among).distance.reshape(rays.lines, rays.columns)
    random = np.random.default_rng([shoot.seed, 4, index])
    scale, offset = random.uniform(0.55, 0.9) / inverse.max(), random.uniform(0.02, 0.09)
    return np.where(inverse > 0, np.rint(65535 * (scale * inverse + offset)), 0).astype(np.uint16)


def _write_model(shoot: _Shoot, cloud: SurfaceSample, rows: list[NDArray[np.int64]], points: int) -> None:
    """Keeps `points` of the cloud that two training panoramas see, adds an error, and writes sparse/0."""
    views = np.bincount(np.concatenate(rows[: shoot.place.training]), minlength=len(cloud.points))
    random = np.random.default_rng([shoot.seed, 5])
    kept = np.sort(random.permutation(np.flatnonzero(views >= 2))[:points])
    row_of = np.full(len(cloud.points), -1)
    row_of[kept] = np.arange(len(kept))
    where, distance = cloud.points[kept], cloud.distance[kept, None]
    noisy = where + random.standard_normal(where.shape) * (0.004 + 0.001 * distance)
    images, observations = [], []
    for index, (rotation, center) in enumerate(zip(shoot.place.rotations, shoot.place.centers, strict=True)):
        images.append((shoot.image(index), rotation, -rotation @ center))
        seen = row_of[rows[index]]
        seen = seen[seen >= 0]
        observations.append((seen, project((where[seen] - center) @ rotation.T, shoot.width)))
    write_colmap(
        shoot.folder / "sparse" / "0",
        images,
        width=shoot.width,
        height=shoot.width // 2,
        points=noisy,
        colors=cloud.colors[kept],
        observations=observations,
    )


def project(points: Floats, width: int) -> NDArray[np.float64]:
    """Pixels (N, 2), u in [0, W), of camera-space points (N, 3): COLMAP's EQUIRECTANGULAR.

    Not `scene.projection`: its formulas round differently, which would change the bytes of the town.
    """
    x, y, z = points.T
    u = width / (2 * np.pi) * np.arctan2(x, z) + width / 2
    v = width / (2 * np.pi) * np.arcsin(y / np.linalg.norm(points, axis=1)) + width / 4
    return np.stack([u % width, v], axis=1)


def _write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Writes an image, channels in cv2's order, atomically."""
    _, encoded = cv2.imencode(".png", image)
    write_bytes(path, encoded.tobytes())
