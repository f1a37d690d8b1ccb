"""Adaptive density control of 3DGS: clone, split, prune, reset opacities. The sky stays out, and last."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from panolog.scene.gaussians import logit
from panolog.workers.training.config import DensifyConfig
from panolog.workers.training.optimizer import Trainee

SPLIT_SHRINK = 1.6  # a Gaussian's two halves are smaller by this factor; 3DGS


@dataclass(eq=False)
class Statistics:
    """Screen gradients of the S scene Gaussians since the last densification."""

    gradient: Tensor  # (S,) sum of their lengths, in units of half the image size
    views: Tensor  # (S,) how many views saw each

    @staticmethod
    def zeros(count: int, device: torch.device | str) -> "Statistics":
        """Nothing seen yet."""
        return Statistics(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, screen_gradient: Tensor, visible: Tensor, width: int, height: int) -> None:
        """Count one view: screen gradients (N, 2) ∂L/∂(u, v) per pixel and visibility (N,), sky rows ignored.

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
    trainee: Trainee,
    statistics: Statistics,
    config: DensifyConfig,
    extent: float,
    random: np.random.Generator,
) -> None:
    """Clone small and split large Gaussians with large screen gradients, prune transparent ones (3DGS).

    New Gaussians start with zero moments. Statistics are not touched: their rows no longer fit afterwards.

    Args: statistics of the trainee's scene Gaussians; extent in world units; random for the split positions.
    """
    gaussians = trainee.gaussians
    scene = gaussians.scene
    # compared as logits: a vectorised sigmoid rounds differently where threads divide the rows
    transparent = gaussians.opacities[scene] < logit(config.prune_opacity)
    wanted = (statistics.mean() >= config.gradient) & ~transparent
    wanted = _within_cap(wanted, statistics.mean(), config.max_gaussians, int((~transparent).sum()))
    large = gaussians.scales[scene].amax(1) > math.log(config.percent_dense * extent)
    kept = (~transparent & ~(wanted & large)).nonzero()[:, 0]
    clones = (wanted & ~large).nonzero()[:, 0]
    halves = (wanted & large).nonzero()[:, 0].repeat(2)
    sky = torch.arange(scene.stop, len(gaussians), device=kept.device)
    source = torch.cat([kept, clones, halves, sky])
    fresh = torch.zeros(len(source), dtype=torch.bool, device=kept.device)
    fresh[len(kept) : len(source) - len(sky)] = True
    trainee.rearrange(source, fresh, len(sky))
    start = len(kept) + len(clones)
    _place_halves(trainee, slice(start, start + len(halves)), random)


def _within_cap(wanted: Tensor, gradient: Tensor, cap: int, count: int) -> Tensor:
    """(S,) of those that want to multiply, the ones with the largest gradients for which there is room."""
    room = max(cap - count, 0)
    if cap == 0 or int(wanted.sum()) <= room:
        return wanted
    order = torch.argsort(torch.where(wanted, gradient, -1), descending=True, stable=True)
    allowed = torch.zeros_like(wanted)
    allowed[order[:room]] = True
    return allowed


def _place_halves(trainee: Trainee, rows: slice, random: np.random.Generator) -> None:
    """Draw the positions of split Gaussians from the Gaussian they were, and shrink them."""
    gaussians = trainee.gaussians
    scales, quats = gaussians.scales[rows], gaussians.quats[rows]
    normal = torch.from_numpy(random.standard_normal(tuple(scales.shape), np.float32)).to(scales.device)
    gaussians.means[rows] += rotate(quats, torch.exp(scales) * normal)
    gaussians.scales[rows] = scales - math.log(SPLIT_SHRINK)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """(M, 3) vectors turned by (M, 4) quaternions w x y z of any length but zero."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    axis = unit[:, 1:]
    across = torch.linalg.cross(axis, vectors)
    turned: Tensor = vectors + 2 * (unit[:, :1] * across + torch.linalg.cross(axis, across))
    return turned


def reset_opacities(trainee: Trainee, ceiling: float) -> None:
    """Clamp the opacities of scene Gaussians to `ceiling` and forget their moments (3DGS; app. D)."""
    scene = trainee.gaussians.scene
    trainee.gaussians.opacities[scene].clamp_(max=logit(ceiling))
    trainee.exp_avg["opacities"][scene] = 0
    trainee.exp_avg_sq["opacities"][scene] = 0
