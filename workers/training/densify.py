"""Adaptive density control of 3DGS: clone, split, prune, reset opacities. The sky is not densified."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from panolog.scene.gaussians import Gaussians, logit
from panolog.workers.training.config import DensifyConfig
from panolog.workers.training.optimizer import ModelState

SPLIT_SHRINK = 1.6  # both parts of a split Gaussian are smaller by this factor; 3DGS


@dataclass(eq=False)
class Statistics:
    """Screen gradients of the S scene Gaussians since the last densification."""

    gradient: Tensor  # (S,) sum of their lengths, in units of half the image size
    views: Tensor  # (S,) how many views saw each

    @staticmethod
    def zeros(count: int, device: torch.device | str) -> "Statistics":
        """Before the first view."""
        return Statistics(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, screen_gradient: Tensor, visible: Tensor, width: int, height: int) -> None:
        """Add one view: screen gradients (N, 2) ∂L/∂(u, v) per pixel and visibility (N,), sky rows ignored.

        The length is that of (∂L/∂u · W/2, ∂L/∂v · H/2), as 3DGS has it in normalised device coordinates.
        """
        count = len(self.gradient)
        du, dv = screen_gradient[:count].unbind(1)
        length = torch.sqrt((du * (width / 2)) ** 2 + (dv * (height / 2)) ** 2)
        seen = visible[:count]
        self.gradient += torch.where(seen, length, 0)
        self.views += seen

    def mean(self) -> Tensor:
        """(S,) mean over the views that saw the Gaussian, 0 for none."""
        return self.gradient / self.views.clamp(min=1)


def densify(
    state: ModelState,
    statistics: Statistics,
    config: DensifyConfig,
    extent: float,
    random: np.random.Generator,
) -> None:
    """Clone small and split large Gaussians with large screen gradients, prune transparent ones (3DGS).

    New Gaussians start with zero moments. The rows of the statistics no longer match afterwards.

    Args: statistics of the scene Gaussians; extent in world units; random for the split positions.
    """
    kept, clones, splits, sky = _sources(state.gaussians, statistics, config, extent)
    source = torch.cat([kept, clones, splits, sky])
    new = torch.zeros(len(source), dtype=torch.bool, device=kept.device)
    new[len(kept) : len(source) - len(sky)] = True
    state.rearrange(source, new, len(sky))  # nothing else holds the former parameters: they are freed
    start = len(kept) + len(clones)
    _place_splits(state, slice(start, start + len(splits)), random)


def _sources(
    gaussians: Gaussians, statistics: Statistics, config: DensifyConfig, extent: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows int64 that stay, that are cloned, that are split (twice each), and of the sky."""
    scene = gaussians.scene
    # compared as logits: the rounding of a vectorised sigmoid depends on how threads divide the rows
    transparent = gaussians.opacities[scene] < logit(config.prune_opacity)
    selected = (statistics.mean() >= config.gradient) & ~transparent
    selected = _within_cap(selected, statistics.mean(), config.max_gaussians, int((~transparent).sum()))
    large = gaussians.scales[scene].amax(1) > math.log(config.percent_dense * extent)
    kept = (~transparent & ~(selected & large)).nonzero()[:, 0]
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
    kept = state.gaussians.opacities > logit(ceiling)  # as logits, see `_sources`
    kept[state.gaussians.scene.stop :] = True
    source = kept.nonzero()[:, 0]
    state.rearrange(source, torch.zeros_like(source, dtype=torch.bool), state.gaussians.sky)


def reset_opacities(state: ModelState, ceiling: float) -> None:
    """Clamp the opacities of scene Gaussians to `ceiling` and zero their moments (3DGS; app. D)."""
    scene = state.gaussians.scene
    state.gaussians.opacities[scene].clamp_(max=logit(ceiling))
    state.exp_avg["opacities"][scene] = 0
    state.exp_avg_sq["opacities"][scene] = 0
