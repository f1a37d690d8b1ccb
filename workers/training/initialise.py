"""The model before training: Gaussians from the sparse cloud; and the characteristic lengths of a scene."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from panolog.partition.bounds import baseline
from panolog.scene.gaussians import SH_REST, Gaussians, logit
from panolog.scene.model import Scene
from panolog.workers.training.config import TrainConfig

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)
OPACITY = 0.1  # initial, 3DGS
NEIGHBOURS = 3  # whose distances set the size of a Gaussian, 3DGS
# Initial sizes as fractions of the distance to the nearest camera. A lone point, far from its neighbours, may
# not cover more than a fifth of a radian; a duplicate point may not vanish (a pixel is about 3e-3 radians).
SCALE_MIN, SCALE_MAX = 1e-4, 0.2


def scene_length(scene: Scene) -> float:
    """The training cameras' baseline b̂ (eq. 8), world units: what makes other lengths free of their unit."""
    return baseline(scene.centers[list(scene.train)])


def camera_extent(scene: Scene, views: Sequence[int]) -> float:
    """Extent of 3DGS: 1.1 × the largest distance of a camera from the mean of them, world units.

    At least that of two neighbours, for views at one position.

    Args: views, the rows of `scene.panoramas` that are trained on. So a block takes steps, and splits at
    sizes, that fit its part of the scene.
    """
    centers = scene.centers[list(views)]
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    return 1.1 * max(radius, scene_length(scene) / 2)


def near_distance(scene: Scene, config: TrainConfig) -> float:
    """The least radial distance drawn, in world units: `config.near` times the cameras' baseline (eq. 8)."""
    return config.near * scene_length(scene)


def sh_of_color(colors: NDArray[np.float64]) -> torch.Tensor:
    """(N, 3) RGB in [0, 1] to (N, 1, 3) coefficients of degree 0."""
    return torch.from_numpy(((colors - 0.5) / SH_C0).astype(np.float32))[:, None, :]


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


def scene_gaussians(scene: Scene) -> Gaussians:
    """One Gaussian for each point of the sparse cloud, its size the distance of its neighbours (3DGS).

    Its bounds come from the training cameras: no pose that is held out has an influence.
    """
    spacing = _neighbour_distance(scene.points)
    camera, _ = cKDTree(scene.centers[list(scene.train)]).query(scene.points)
    tiny = np.finfo(np.float32).tiny  # a point in a camera
    scales = np.clip(spacing, SCALE_MIN * camera, SCALE_MAX * camera).clip(min=tiny)
    return isotropic(scene.points, scales, scene.colors / 255.0, OPACITY)


def _neighbour_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 3) to (P,): root mean square distance to the three nearest others; inf if there are fewer."""
    distances, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    # the first is the point itself, or a duplicate, also at distance 0
    mean: NDArray[np.float64] = np.sqrt((distances[:, 1:] ** 2).mean(axis=1))
    return mean
