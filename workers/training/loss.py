"""The loss of a view (eq. 6), and the targets of its depth part: depth maps aligned by eq. 4."""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer.baked import Baked
from panolog.renderer.losses import sphere_rows
from panolog.scene.depth_alignment import Alignment, AlignmentError, align_depth, inverse_prior
from panolog.scene.images import View
from panolog.scene.model import Scene
from panolog.workers.training.config import DepthConfig, LossConfig, TrainConfig
from panolog.workers.training.initialise import scene_length
from panolog.workers.training.schedule import Schedule


@dataclass(eq=False)
class DepthTargets:
    """Targets of the depth loss for one task. Each panorama is aligned when it is first seen."""

    scene: Scene
    config: DepthConfig
    seed: int
    notices: list[str] = field(default_factory=list)  # of images left out or fitted again, not yet reported
    _aligned: dict[int, Alignment | None] = field(default_factory=dict)  # by row

    def target(self, view: View) -> tuple[Tensor, Tensor] | None:
        """Target (H, W) inverse radial depth and validity (H, W) bool of a view; None without usable depth.

        Sky is where the sky mask says so, without one where the prior is 0; it is a valid 0 if the config has
        it. A prior of 0 that a sky mask calls foreground is a hole; holes and masked pixels are not valid.
        """
        if view.inverse_depth is None or (alignment := self.align(view)) is None:
            return None
        prior = inverse_prior(view.inverse_depth, self.config.kind)
        sky = prior <= 0 if view.sky is None else view.sky
        target = torch.where(sky, 0, (alignment.scale * prior + alignment.offset).clamp(min=0))
        valid = sky | (prior > 0) if self.config.sky else ~sky & (prior > 0)
        return target, valid if view.mask is None else valid & view.mask

    def align(self, view: View) -> Alignment | None:
        """The alignment of a view, by its mask when it is first seen; None without usable depth."""
        if view.inverse_depth is None:
            return None
        row = view.row
        if row not in self._aligned:
            name = self.scene.panoramas[row].name
            try:
                found = align_depth(self.scene, view, self.seed, kind=self.config.kind)
                self._aligned[row] = found
                if found.note:
                    self.notices.append(f"{name}: {found.note}")
            except AlignmentError as error:
                self._aligned[row] = None
                self.notices.append(f"{name} is left out of the depth loss: {error}")
        return self._aligned[row]


class Targets(NamedTuple):
    """What counts of a view, and factors of the means over it: as in `renderer.cuda.iteration.Problem`."""

    mask: Tensor | None
    share: Tensor | None
    depth: tuple[Tensor, Tensor] | None
    depth_share: Tensor | None


class Loss:
    """The parts of eq. 6 for the views of one task."""

    def __init__(self, scene: Scene, config: TrainConfig, seed: int, schedule: Schedule) -> None:
        self._schedule = schedule
        self.depth = DepthTargets(scene, config.depth, seed)
        self.unit = scene_length(scene) if config.depth.unit == "baseline" else 1.0  # world units

    def targets(self, view: View, depth_weight: float, around: Baked | None = None) -> Targets:
        """What counts: of a view that is rendered with an exterior the active pixels.

        Means over them times their share have the gradients of the means over all: the others are constant.
        """
        mask, depth = view.mask, self.depth.target(view) if depth_weight > 0 else None
        if around is None:
            return Targets(mask, None, depth, None)
        height, width, _ = view.image.shape
        active = around.active(width, height)
        counts, share = _active_part(torch.ones_like(active) if mask is None else mask, active)
        if depth is None:
            return Targets(counts, share, None, None)
        valid, depth_share = _active_part(depth[1], active)
        return Targets(counts, share, (depth[0], valid), depth_share)

    def aligned(self, view: View, iteration: int) -> View:
        """The view, whose depth is aligned by its own mask: what is found to move meanwhile changes that."""
        if self.depth_weight(iteration) > 0:
            self.depth.align(view)
        return view

    def depth_weight(self, iteration: int) -> float:
        """w(t) of eq. 5; for inverse depths in units of 1 / b̂ they are parallaxes γ = b̂ / z, in radians."""
        return self._schedule.depth_weight(iteration) * self.unit


def loss_rows(config: LossConfig, view: View) -> Tensor | None:
    """(H,) weights of the rows of a view in the photometric part of eq. 6; None: all 1."""
    return sphere_rows(len(view.image), view.mask, view.image.device) if config.sphere else None


def _active_part(mask: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """The active pixels of a mask, and () float64 their share of it."""
    part = active & mask
    return part, part.sum(dtype=torch.float64) / mask.sum(dtype=torch.float64).clamp(min=1)
