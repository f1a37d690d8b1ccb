"""The model before training, from the sparse cloud and with a sky (eq. 3); characteristic lengths of a scene.

The sky is a sphere of distant Gaussians, so that near ones need not model it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from panolog.partition.bounds import baseline, strays
from panolog.partition.cells import Volume
from panolog.scene.gaussians import SH_C0, SH_REST, Gaussians, concatenate, logit
from panolog.scene.images import View, pixels, unexposed
from panolog.scene.model import Scene, of_one_color
from panolog.scene.projection import fibonacci_sphere, project_to_pixels
from panolog.workers.training.config import SkyConfig, TrainConfig
from panolog.workers.training.surfaces import NO_POINTS, Points

DARKEST = 0.25 / 255  # initial: colours are clamped at 0, where they have no gradient and would stay black
NEIGHBOURS = 3  # whose distances set the size of a Gaussian, 3DGS
# Initial sizes as fractions of the distance to the nearest camera. A lone point, far from its neighbours, may
# not cover more than a fifth of a radian; a duplicate point may not vanish (a pixel is about 3e-3 radians).
SCALE_MIN, SCALE_MAX = 1e-4, 0.2
_RIM = 3.0  # distances of neighbours: what is farther behind the rim of the sky hardly shows
OUTSIDE = 8  # pixels of a panorama that what is outside of a district begins with


def scene_length(scene: Scene) -> float:
    """The training cameras' baseline b̂ (eq. 8), world units: what makes other lengths free of their unit."""
    return baseline(scene.centers[list(scene.train)])


def camera_extent(scene: Scene, views: Sequence[int]) -> float:
    """Extent of 3DGS: 1.1 × the largest distance of a camera from the mean of them, world units.

    Without `strays`, and at least that of two neighbours, for views at one position.

    Args: views, the rows of `scene.panoramas` that are trained on. So a block takes steps, and splits at
    sizes, that fit its part of the scene.
    """
    return extent_of(scene.centers[list(views)], scene_length(scene))


def extent_of(centers: NDArray[np.float64], apart: float) -> float:
    """`camera_extent` of cameras at centers (K, 3). Args: apart, the distance of neighbours, world units."""
    centers = centers[~strays(centers)]
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return 1.1 * max(radius, apart / 2)


def near_distance(scene: Scene, config: TrainConfig) -> float:
    """The least radial distance drawn, in world units: `config.near` times the cameras' baseline (eq. 8)."""
    return config.near * scene_length(scene)


def sh_of_color(colors: NDArray[np.float64]) -> torch.Tensor:
    """(N, 3) RGB in [0, 1] to (N, 1, 3) coefficients of degree 0; black is a little brighter."""
    return torch.from_numpy(((np.maximum(colors, DARKEST) - 0.5) / SH_C0).astype(np.float32))[:, None, :]


def isotropic(
    means: NDArray[np.float64], scales: NDArray[np.float64], colors: NDArray[np.float64], opacity: float
) -> Gaussians:
    """Round Gaussians of one opacity and no view dependence.

    Args: means (N, 3) and scales (N,) in world units, colors (N, 3) in [0, 1], opacity in (0, 1).
    """
    count = len(means)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=quats,
        scales=torch.from_numpy(np.log(scales).astype(np.float32))[:, None].repeat(1, 3),
        opacities=torch.full((count,), logit(opacity)),
        sh0=sh_of_color(colors),
        shN=torch.zeros(count, SH_REST, 3),
    )


def scene_gaussians(
    scene: Scene,
    chosen: NDArray[np.int64] | None = None,
    more: Points = NO_POINTS,
    opacity: float = 0.1,
) -> Gaussians:
    """One Gaussian for each point of the sparse cloud, its size the distance of its neighbours (3DGS).

    Its bounds come from the training cameras: no pose that is held out has an influence.

    Args: chosen, rows of the cloud as of `points_of`, None = all; more, points beyond the cloud; opacity in
    (0, 1).
    """
    chosen = np.arange(len(scene.points)) if chosen is None else chosen
    points = np.concatenate([scene.points[chosen], more.points])
    colors = np.concatenate([scene.colors[chosen], more.colors]) / 255.0
    spacing = _neighbour_distance(points)
    camera, _ = cKDTree(scene.centers[list(scene.train)]).query(points)
    tiny = np.finfo(np.float32).tiny  # a point in a camera
    scales = np.clip(spacing, SCALE_MIN * camera, SCALE_MAX * camera).clip(min=tiny)
    return isotropic(points, scales, colors, opacity)


def points_of(
    scene: Scene, views: Sequence[int], district: Volume | None = None, width: int = 0
) -> NDArray[np.int64]:
    """(P,) rows of the points from which Stage I on some views starts.

    All for all training views, and where no view has observed any; else those that the views have observed.
    Outside of a district, which does not keep what is there, one for each cube that spans `OUTSIDE` pixels or
    less for the nearest of its cameras. Args: width of the panoramas, pixels.
    """
    observed = np.unique(np.concatenate([scene.panoramas[row].observed for row in views]))
    if len(views) == len(scene.train) or not len(observed):
        observed = np.arange(len(scene.points))
    if district is None:
        return observed
    inside = district.contains(scene.points[observed])
    others = scene.points[observed[~inside]]
    distance, _ = cKDTree(scene.centers[list(views)]).query(others)
    level = np.floor(np.log2((distance * OUTSIDE * 2 * math.pi / width).clip(min=np.finfo(float).tiny)))
    cubes = np.floor(others / np.exp2(level)[:, None])
    _, first = np.unique(np.column_stack([level, cubes]), axis=0, return_index=True)
    return np.sort(np.concatenate([observed[inside], observed[~inside][first]]))


def evenly(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """An even part of these rows (P,) if they are more than `most`; all if that is 0."""
    return rows[np.arange(most) * len(rows) // most] if 0 < most < len(rows) else rows


def first_model(
    scene: Scene,
    config: TrainConfig,
    chosen: NDArray[np.int64],
    more: Points,
    views: Sequence[int],
    pixels: int,
    view: Callable[[int], View | None],
) -> tuple[Gaussians, Tensor]:
    """What Stage I starts with: `scene_gaussians` and `sky_gaussians`; (N_sky,) which of the sky are sky.

    Points that all have about one colour, as of programs that write none, get that of the panoramas.
    Args: pixels of a panorama.
    """
    if len(chosen) and of_one_color(scene.colors[chosen]):
        scene = _with_colors(scene, chosen, views, view)
    points, count = scene_gaussians(scene, chosen, more, config.initial_opacity), config.sky.number(pixels)
    if not count:
        return points, torch.ones(0, dtype=torch.bool)
    sky, seen = sky_gaussians(scene, config.sky, count, views, view)
    return concatenate(points, sky), seen


def _with_colors(
    scene: Scene, chosen: NDArray[np.int64], views: Sequence[int], view: Callable[[int], View | None]
) -> Scene:
    """The scene, whose chosen points have the colour of their pixels in the nearest of the views."""
    colors = scene.colors.copy()
    _, nearest = cKDTree(scene.centers[list(views)]).query(scene.points[chosen])
    for place in np.unique(nearest):
        rows = chosen[nearest == place]
        found, _ = _colors(scene, scene.points[rows], [views[place]], view)
        colors[rows] = np.rint(255 * found.clip(0, 1))
    return replace(scene, colors=colors)


def _neighbour_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 3) to (P,): root mean square distance to the three nearest others; inf if there are fewer."""
    distances, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    # the first is the point itself, or a duplicate, also at distance 0
    mean: NDArray[np.float64] = np.sqrt((distances[:, 1:] ** 2).mean(axis=1))
    return mean


def sky_gaussians(
    scene: Scene, config: SkyConfig, count: int, views: Sequence[int], view: Callable[[int], View | None]
) -> tuple[Gaussians, Tensor]:
    """N_sky Gaussians on the sphere of radius κ · max‖x_i − C̄‖ about the training cameras' centroid (eq. 3).

    The maximum is over all sparse points, as the paper has it: a stray point makes the sky more distant, but
    changes neither its directions nor the angular size of its Gaussians.

    Args: count, N_sky; views, the rows of `scene.panoramas` to colour it from; view, which decodes a row,
    None = leave out.
    Returns: them; (N_sky,) bool, which are seen as sky or are next to one that is: all without sky masks.
    """
    centroid = scene.centers[list(scene.train)].mean(axis=0)
    radius = config.kappa * float(np.linalg.norm(scene.points - centroid, axis=1).max())
    means = centroid + radius * fibonacci_sphere(count)
    evenly = np.linspace(0, len(views) - 1, min(config.views, len(views))).astype(int)
    colors, seen = _colors(scene, means, [views[i] for i in evenly], view)
    gaussians = isotropic(means, np.full(count, radius * config.sigma(count)), colors, config.opacity)
    if seen.any():
        apart, _ = cKDTree(means[seen]).query(means)
        seen = apart <= _RIM * radius * math.sqrt(4 * math.pi / count)
    else:
        seen = np.ones(count, bool)
    return replace(gaussians, sky=count), torch.from_numpy(seen)


def _colors(
    scene: Scene, points: NDArray[np.float64], rows: Sequence[int], view: Callable[[int], View | None]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(N, 3) mean colours in [0, 1] of the pixels that points (N, 3) fall on: the sky ones, else all.

    Of the scene, without the exposures of the panoramas. And (N,), whether any of these pixels is sky.
    """
    sums = np.zeros((2, len(points), 3))  # of sky pixels, of all pixels
    counts = np.zeros((2, len(points), 1))
    for row, seen in zip(rows, map(view, rows), strict=True):
        if seen is None:
            continue
        height, width = seen.image.shape[:2]
        _, v, u = project_to_pixels(scene.panoramas[row], points, width, height)
        color = unexposed(pixels(seen.image, v, u) / 255.0, seen.exposure)
        usable = np.ones(len(points), bool) if seen.mask is None else pixels(seen.mask, v, u)
        sky = usable if seen.sky is None else usable & pixels(seen.sky, v, u)
        for kind, chosen in enumerate((sky, usable)):
            sums[kind] += color * chosen[:, None]
            counts[kind] += chosen[:, None]
    means = sums / np.maximum(counts, 1)
    unseen = np.where(counts[1] > 0, means[1], 0.5)
    return np.where(counts[0] > 0, means[0], unseen), counts[0][:, 0] > 0
