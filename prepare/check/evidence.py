"""What the check measures on: some decoded panoramas of a scene, and the points that each of them sees."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import ColmapImage, read_colmap
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.model import Panorama, Scene, of_one_color
from panolog.scene.projection import project_to_fractions, project_to_pixels
from panolog.scene.read import model_folder

Array = NDArray[np.float64]
Tracks: TypeAlias = Mapping[str, ColmapImage]
Found = TypeVar("Found")
MEMORY = 400_000_000  # bytes of decoded panoramas
MOST_VIEWS, FEWEST_VIEWS = 48, 8
POINTS = 1500  # of each panorama
_FEW = 20  # points whose colours fit some wrong pose by chance
_GRID, _BEHIND = 48, 1.2  # columns of a grid of directions; farther than that times the nearest is hidden
WIDEST = 4096  # pixels; wider panoramas are shrunk


def is_colorless(colors: NDArray[np.uint8] | Array) -> bool:
    """Whether colours (N, 3) of 0 to 255 say nothing: there are few, or they are all about the same."""
    return len(colors) < _FEW or of_one_color(colors)


@dataclass(frozen=True, eq=False)
class Evidence:
    """A scene of K panoramas and P points, with V views, which are some of the panoramas."""

    scene: Scene
    colors: Array  # (P, 3) RGB in [0, 255]
    seen: tuple[NDArray[np.int64], ...]  # K of (M,) rows of points, at most POINTS
    pixels: tuple[Array, ...] | None  # K of (M, 2) where they were observed, in units of the width
    views: tuple[int, ...]  # rows of the panoramas that are decoded
    pictures: tuple[NDArray[np.uint8], ...]  # V of (H, W, 3) RGB

    @property
    def colorless(self) -> bool:
        """Whether colours of points say nothing, so that only patches and tracks can be checked."""
        return is_colorless(self.colors)

    def directions(self, row: int, points: Array) -> Array:
        """(N, 3) points (N, 3) of the world in the axes of panorama `row`."""
        panorama = self.scene.panoramas[row]
        local: Array = points @ panorama.rotation.T + panorama.translation
        return local


def gather_evidence(scene: Scene) -> Evidence:
    """Decodes some panoramas of the scene, evenly spread, and picks points, always the same ones.

    Without tracks a panorama is taken to see the points nearest to it that no others are in front of.

    Raises SceneError: a panorama cannot be decoded, or the model is damaged.
    """
    views = _spread(scene)
    rows, pixels = _tracks(scene, views)
    decoded = [decode_with_alpha(scene.panoramas[row].image, min(scene.width, WIDEST)) for row in views]
    for row, (_, used) in zip(views, decoded, strict=True):
        if used is not None:  # of what is transparent nothing is seen
            points, size = scene.points[rows[row]], used.shape[::-1]
            _, v, u = project_to_pixels(scene.panoramas[row], points, *size)
            rows[row] = rows[row][used[v, u]]
            if pixels is not None:
                pixels[row] = pixels[row][used[v, u]]
    return Evidence(
        scene=scene,
        colors=scene.colors.astype(np.float64),
        seen=tuple(rows),
        pixels=None if pixels is None else tuple(pixels),
        views=views,
        pictures=tuple(picture for picture, _ in decoded),
    )


def _spread(scene: Scene) -> tuple[int, ...]:
    width = min(scene.width, WIDEST)
    count = int(np.clip(MEMORY // (3 * width * width // 2), FEWEST_VIEWS, MOST_VIEWS))
    total = len(scene.panoramas)
    return tuple(np.linspace(0, total - 1, min(count, total)).astype(int).tolist())


def read_tracks(scene: Scene) -> Tracks | None:
    """What each panorama has observed, by its name; None for a scene without observations.

    Raises SceneError if the model is damaged.
    """
    if not any(len(panorama.observed) for panorama in scene.panoramas):
        return None
    return {image.name: image for image in read_colmap(model_folder(scene.root)).images}


def _tracks(scene: Scene, views: Sequence[int]) -> tuple[list[NDArray[np.int64]], list[Array] | None]:
    """What each panorama sees, and where in units of the width; without tracks only `views` see any.

    A model whose images have no lines of observations says what each sees, but not where.
    """
    if (images := read_tracks(scene)) is None:
        decoded, nothing = set(views), np.empty(0, np.int64)
        return [
            likely_seen(scene.points, panorama.center) if row in decoded else nothing
            for row, panorama in enumerate(scene.panoramas)
        ], None
    if not any(len(image.points) for image in images.values()):
        observed = [panorama.observed for panorama in scene.panoramas]
        return [seen[_some(len(seen), row)] for row, seen in enumerate(observed)], None
    rows, pixels = [], []
    for index, panorama in enumerate(scene.panoramas):
        image = images.get(panorama.name)
        if image is None:  # its name has another spelling in COLMAP
            rows.append(np.empty(0, np.int64))
            pixels.append(np.empty((0, 2)))
            continue
        kept = _some(len(image.points), index)
        rows.append(image.points[kept])
        pixels.append(image.pixels[kept] / image.camera.width)
    return rows, pixels


def likely_seen(points: Array, center: Array) -> NDArray[np.int64]:
    """(M,) rows of the nearest points (P, 3) that are probably not hidden by one in the same direction.

    Of points at the same place, which a cloud may have by thousands, the first counts.
    """
    distance = np.linalg.norm(points - center, axis=1)
    rows = np.argsort(distance, kind="stable")
    rows = rows[np.diff(distance[rows], prepend=-1) > 0][: 4 * POINTS]
    where = project(points[rows] - center)  # the grid's orientation is of no matter
    cell = np.floor(where * _GRID).astype(np.int64) @ (1, _GRID)
    _, first, of = np.unique(cell, return_index=True, return_inverse=True)
    clear = distance[rows] <= _BEHIND * distance[rows[first[of]]]
    return np.sort(rows[clear][:POINTS]).astype(np.int64)


def points_seen(scene: Scene, panorama: Panorama, most: int) -> NDArray[np.int64]:
    """(M,) rows of points that a panorama has seen, thinned to about `most`; at least one.

    For a panorama without tracks those that it is likely to see.
    """
    seen = panorama.observed if len(panorama.observed) else likely_seen(scene.points, panorama.center)
    return seen[:: max(1, len(seen) // most)]


def _some(count: int, seed: int) -> NDArray[np.int64]:
    """At most POINTS of `count` rows, at random."""
    if count <= POINTS:
        return np.arange(count)
    return np.sort(np.random.default_rng([seed, 11]).permutation(count)[:POINTS]).astype(np.int64)


def bilinear(picture: NDArray[np.uint8] | NDArray[np.float32], where: Array) -> Array:
    """(N, channels) bilinear values of a picture (H, W, channels) at `where` (N, 2) in units of its width.

    Pixel centres are at +0.5; columns wrap, rows end.
    """
    height, width = picture.shape[:2]
    x, y = where[:, 0] * width - 0.5, np.clip(where[:, 1] * width - 0.5, 0, height - 1)
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    columns = [(left.astype(np.int64) + step) % width for step in (0, 1)]
    rows = [np.minimum(top.astype(np.int64) + step, height - 1) for step in (0, 1)]
    upper = picture[rows[0], columns[0]] * (1 - fx) + picture[rows[0], columns[1]] * fx
    lower = picture[rows[1], columns[0]] * (1 - fx) + picture[rows[1], columns[1]] * fx
    values: Array = upper * (1 - fy) + lower * fy
    return values


def project(directions: Array) -> Array:
    """(N, 2) in units of the width, of directions (N, 3) in camera axes."""
    return project_to_fractions(directions) * (1.0, 0.5)


def offsets(seen: Array, directions: Array) -> Array:
    """(N, 2) from where directions (N, 3) in camera axes are to where they are seen (N, 2), along the sphere.

    All in units of the width: u is the shorter way around, shrunk by the cosine of the latitude.
    """
    apart = seen - project(directions)
    apart[:, 0] = (apart[:, 0] + 0.5) % 1.0 - 0.5
    apart[:, 0] *= np.cos(2 * np.pi * (seen[:, 1] - 0.25))
    return apart


def in_threads(function: Callable[..., Found], *arguments: Iterable[Any]) -> Iterator[Found]:
    """What a function returns for each panorama, in order; OpenCV has one thread in each thread."""
    with ThreadPoolExecutor(initializer=cv2.setNumThreads, initargs=(1,)) as threads:
        yield from threads.map(function, *arguments)


def correlation(a: Array, b: Array) -> float:
    """Pearson's, over all of (N, channels), each channel about its mean; 0 where nothing varies."""
    if len(a) < 3:
        return 0.0
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / scale) if scale > 0 else 0.0


def color_agreement(evidence: Evidence, view: int, directions: Array, rows: NDArray[np.int64]) -> float:
    """How well the colours of points (M,) fit the pixels of a decoded view in `directions` (M, 3)."""
    found = bilinear(evidence.pictures[view], project(directions))
    return correlation(found, evidence.colors[rows])


def median_or_zero(values: Sequence[float]) -> float:
    """The median of values; 0 of none."""
    return float(np.median(values)) if len(values) else 0.0
