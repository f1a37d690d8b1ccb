"""Adaptive density control of 3DGS: clone, split, prune, reset opacities. The sky is not densified."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.scene.gaussians import Gaussians, logit
from panolog.workers.training.config import DensifyConfig
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.schedule import Schedule

STATISTICS = "statistics."  # before the names of `Statistics.tensors`
SPLIT_SHRINK = 1.6  # both parts of a split Gaussian are smaller by this factor; 3DGS
_EPSILON = 1e-6  # distance of opacities from 0 and 1 that are computed with


@dataclass(eq=False)
class Statistics:
    """Screen gradients of the S scene Gaussians since the last densification."""

    gradient: Tensor  # (S,) weighted sum of their lengths
    views: Tensor  # (S,) sum of the weights of the views that saw each
    config: DensifyConfig  # how lengths and weights are measured
    absolute: Tensor | None = None  # (S,) as `gradient`, of absolute gradients; where the config needs them

    @staticmethod
    def zeros(count: int, device: torch.device | str, config: DensifyConfig) -> "Statistics":
        """Before the first view."""
        gradient, views, absolute = (torch.zeros(count, device=device) for _ in range(3))
        return Statistics(gradient, views, config, absolute if config.split_gradient > 0 else None)

    def anew(self, count: int) -> "Statistics":
        """Statistics of so many Gaussians before the first view, measured in the same way."""
        return Statistics.zeros(count, self.gradient.device, self.config)

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor], config: DensifyConfig) -> "Statistics":
        """The inverse of `tensors`."""
        gradient, views = (tensors[f"{STATISTICS}{name}"] for name in ("gradient", "views"))
        return Statistics(gradient, views, config, tensors.get(f"{STATISTICS}absolute"))

    def tensors(self) -> dict[str, Tensor]:
        """By name, for checkpoints, sharing memory."""
        return {f"{STATISTICS}{name}": it for name, it in vars(self).items() if isinstance(it, Tensor)}

    def add(self, screen_gradient: Tensor, visible: Tensor, means: Tensor, camera: Camera) -> None:
        """Add one view; sky rows are ignored. A card does it in `iteration_statistics` of csrc/cuda.

        The length is that of (∂L/∂u · W/2, ∂L/∂v · H/2), as 3DGS has it in normalised device coordinates.
        As an angle it is that of (∂L/∂u · W/2, ∂L/∂v · H cos φ), half turns on the sphere: a radian has
        (W / 2π cos φ, H / π) pixels, and a pixel, which the loss counts, the solid angle cos φ. A view's
        weight is 1, or by contribution 1 / r², as its solid angle, and 0 where nothing of it is seen.

        Args: screen_gradient (N, 2) ∂L/∂(u, v) per pixel, and absolute gradients in two columns more, where
        these count; visible (N,), means (N, 3).
        """
        count = len(self.gradient)
        vertical: Tensor | float = camera.height / 2
        angle, contribution = self.config.measure == "angle", self.config.views == "contribution"
        if angle or contribution:
            y, squared = _from_camera(means[:count], camera)
            if angle:
                vertical = camera.height * torch.sqrt((1 - y * y / squared).clamp(min=0))
        seen, horizontal, columns = visible[:count], camera.width / 2, screen_gradient[:count].unbind(1)
        lengths = [
            torch.sqrt((du * horizontal) ** 2 + (dv * vertical) ** 2)
            for du, dv in zip(columns[::2], columns[1::2], strict=True)
        ]
        weight = torch.where(seen & (lengths[0] > 0), 1 / squared, 0) if contribution else seen
        for total, length in zip((self.gradient, self.absolute), lengths, strict=False):
            if total is not None:
                total.add_(torch.where(weight > 0, length * weight, 0))
        self.views += weight

    def mean(self) -> Tensor:
        """(S,) mean over the views that saw the Gaussian, 0 for none."""
        return self._mean(self.gradient)

    def mean_absolute(self) -> Tensor:
        """(S,) the same of absolute gradients; the config must need them."""
        assert self.absolute is not None
        return self._mean(self.absolute)

    def _mean(self, total: Tensor) -> Tensor:
        return total / self.views.clamp(min=torch.finfo(torch.float32).tiny)


def _from_camera(means: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """(S,) downward coordinate of means (S, 3) in the camera, and their squared distance.

    Written out: the order of the sums in a product of matrices depends on the threads.
    """
    x, y, z = means.unbind(1)
    rotation, translation = camera.rotation.tolist(), camera.translation.tolist()
    at = [r[0] * x + r[1] * y + r[2] * z + t for r, t in zip(rotation, translation, strict=True)]
    return at[1], at[0] * at[0] + at[1] * at[1] + at[2] * at[2]


def densify(
    state: ModelState,
    statistics: Statistics,
    config: DensifyConfig,
    extent: float,
    random: np.random.Generator,
) -> None:
    """Clone small and split large Gaussians with large screen gradients, prune transparent ones (3DGS).

    New Gaussians start with zero moments. The rows of the statistics no longer match afterwards.

    Args: statistics of the scene Gaussians; extent in world units, that `percent_dense` is a fraction of;
    random for the split positions.
    """
    kept, clones, splits, sky = _sources(state.gaussians, statistics, config, extent)
    source = torch.cat([kept, clones, splits, sky])
    new = torch.zeros(len(source), dtype=torch.bool, device=kept.device)
    new[len(kept) : len(source) - len(sky)] = True
    state.rearrange(source, new, len(sky))  # nothing else holds the former parameters: they are freed
    start, pairs = len(kept) + len(clones), len(splits) // 2
    if config.long_axis:
        _divide(state, start, pairs)
    else:
        _place_splits(state, slice(start, start + 2 * pairs), random)


def rate_units(
    means: Tensor, centers: NDArray[np.float64], schedule: Schedule, baseline: float, sky: Tensor
) -> dict[str, Tensor]:
    """`ModelState.units` of means (N, 3), of SH of higher degrees, and of the sky, some of which stays.

    Copies have those of their source.
    Args: centers (K, 3) of cameras and their baseline b̂ (eq. 8), world units; sky (N_sky,) bool, which learn.
    """
    units, config = {}, schedule.config
    near = config.sh.near * baseline / schedule.length**2  # as far in all in a run of any length
    apart = cKDTree(centers).query(means.cpu().numpy())[0].astype(np.float32)
    distance = torch.from_numpy(np.maximum(apart, np.finfo(np.float32).tiny)).to(means.device)
    if config.optimizer.unit == "distance":
        units["means"] = distance
    if near > 0:
        units["shN"] = (distance / near).clamp(max=1)
    if not bool(sky.all()):
        learns = torch.ones_like(distance)
        learns[len(learns) - len(sky) :] = sky.to(learns)
        units |= {
            name: units.get(name, 1) * learns for name in ("quats", "scales", "opacities", "sh0", "shN")
        }
    return units


def _sources(
    gaussians: Gaussians, statistics: Statistics, config: DensifyConfig, extent: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows int64 that stay, that are cloned, that are split (twice each), and of the sky."""
    scene = gaussians.scene
    # compared as logits: the rounding of a vectorised sigmoid depends on how threads divide the rows
    removed = gaussians.opacities[scene] < logit(config.prune_opacity)
    large = gaussians.scales[scene].amax(1) > float(np.float32(math.log(config.percent_dense * extent)))
    gradient = statistics.mean()
    chosen = gradient >= config.gradient
    if config.split_gradient > 0:
        chosen = torch.where(large, statistics.mean_absolute() >= config.split_gradient, chosen)
    selected = chosen & ~removed
    if config.least_opacity > 0:
        selected &= gaussians.opacities[scene] > logit(config.least_opacity)
    selected = _within_cap(selected, gradient, config.max_gaussians, int((~removed).sum()))
    kept = (~removed & ~(selected & large)).nonzero()[:, 0]
    clones = (selected & ~large).nonzero()[:, 0]
    splits = (selected & large).nonzero()[:, 0].repeat(2)
    return kept, clones, splits, torch.arange(scene.stop, len(gaussians), device=kept.device)


def _within_cap(selected: Tensor, gradient: Tensor, cap: int, count: int) -> Tensor:
    """(S,) of the selected Gaussians those with the largest gradients, as many as the cap allows."""
    room = max(cap - count, 0)
    if cap == 0 or int(selected.sum()) <= room:
        return selected
    order = torch.argsort(torch.where(selected, gradient, -1), descending=True, stable=True)
    allowed = torch.zeros_like(selected)
    allowed[order[:room]] = True
    return allowed


def _place_splits(state: ModelState, rows: slice, random: np.random.Generator) -> None:
    """Sample the positions of split Gaussians from the original Gaussian, and shrink them."""
    gaussians = state.gaussians
    scales, quats = gaussians.scales[rows], gaussians.quats[rows]
    normal = torch.from_numpy(random.standard_normal(tuple(scales.shape), np.float32)).to(scales.device)
    gaussians.means[rows] += rotate(quats, torch.exp(scales) * normal)
    gaussians.scales[rows] = scales - math.log(SPLIT_SHRINK)


def _divide(state: ModelState, start: int, pairs: int) -> None:
    """Two halves of each split Gaussian along its longest axis: `pairs` rows from `start` on, twice."""
    gaussians = state.gaussians
    rows = torch.arange(start, start + 2 * pairs, device=gaussians.means.device)
    number = np.repeat(np.arange(2), pairs)
    left = stretch_apart(gaussians, rows, number, np.full(2 * pairs, 2))
    write_opacities(gaussians, rows, opacities_of(gaussians, rows) * left)


def stretch_apart(
    gaussians: Gaussians, rows: Tensor, number: NDArray[np.int64], parts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Moves and shortens equal Gaussians, so that they divide what they were along its longest axis.

    n parts are two of their own deviations apart: just so that two still have one maximum. The variance
    stays, so a part has σ √(3 / (n² + 2)).

    Args: rows (M,) int64; number (M,), which part each is, from 0; parts (M,) how many there are of it.
    Returns (M,) the factor of their opacities with which the integral stays too.
    """
    size = np.sqrt(3 / (parts**2 + 2.0))
    place = 2 * size * (number - (parts - 1) / 2)  # in deviations of the whole
    device = gaussians.means.device
    shrink, at = (torch.from_numpy(a.astype(np.float32)).to(device)[:, None] for a in (np.log(size), place))
    scales = gaussians.scales[rows]
    longest = torch.nn.functional.one_hot(scales.argmax(1), 3).to(scales.dtype)
    gaussians.means[rows] += rotate(gaussians.quats[rows], torch.exp(scales) * longest * at)
    gaussians.scales[rows] = scales + longest * shrink
    return np.asarray(1 / (parts * size))


def opacities_of(gaussians: Gaussians, rows: Tensor | slice) -> NDArray[np.float64]:
    """(M,) opacities of those rows, within (0, 1). By numpy: a vectorised sigmoid of torch rounds differently
    for other numbers of threads.
    """
    logits = gaussians.opacities[rows].cpu().numpy().astype(np.float64)
    return np.asarray(1 / (1 + np.exp(-logits))).clip(_EPSILON, 1 - _EPSILON)


def write_opacities(gaussians: Gaussians, rows: Tensor, opacities: NDArray[np.float64]) -> None:
    """The inverse of `opacities_of`, in place."""
    logits = np.log(opacities / (1 - opacities)).astype(np.float32)
    gaussians.opacities[rows] = torch.from_numpy(logits).to(rows.device)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """(M, 3) vectors rotated by (M, 4) quaternions w x y z of any length but zero."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    axis = unit[:, 1:]
    across = torch.linalg.cross(axis, vectors)
    turned: Tensor = vectors + 2 * (unit[:, :1] * across + torch.linalg.cross(axis, across))
    return turned


def drop_unrisen(state: ModelState, ceiling: float) -> None:
    """Remove the scene Gaussians whose opacity is not above `ceiling`, that of the resets (app. D).

    No view gave them, since the last reset, a gradient that made them visible: left in, they would be haze.
    """
    _keep(state, state.gaussians.opacities > logit(ceiling))  # as logits, see `_sources`


def drop_large(state: ModelState, bound: float) -> None:
    """Remove the scene Gaussians with a scale above the bound, in world units (3DGS)."""
    _keep(state, state.gaussians.scales.amax(1) <= math.log(bound))


def _keep(state: ModelState, kept: Tensor) -> None:
    """Remove the other scene Gaussians. Args: kept (N,) bool; of the sky all stay."""
    kept[state.gaussians.scene.stop :] = True
    source = kept.nonzero()[:, 0]
    state.rearrange(source, torch.zeros_like(source, dtype=torch.bool), state.gaussians.sky)


def reset_opacities(state: ModelState, ceiling: float) -> None:
    """Clamp the opacities of the scene Gaussians to `ceiling` and zero their moments (3DGS; app. D)."""
    scene = state.gaussians.scene
    state.gaussians.opacities[scene] = state.gaussians.opacities[scene].clamp(max=logit(ceiling))
    state.exp_avg["opacities"][scene] = 0
    state.exp_avg_sq["opacities"][scene] = 0
