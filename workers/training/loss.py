"""The loss of a view (eq. 6), and the targets of its depth part: depth maps aligned by eq. 4."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from panolog.renderer.baked import Baked
from panolog.renderer.losses import inverse_depth_loss, photometric_loss, sphere_rows
from panolog.renderer.render import Render
from panolog.scene.depth_alignment import Alignment, AlignmentError, align_depth, inverse_prior
from panolog.scene.images import View
from panolog.scene.model import Scene
from panolog.workers.training.config import DepthConfig, TrainConfig
from panolog.workers.training.initialise import scene_length
from panolog.workers.training.schedule import Schedule


@dataclass(eq=False)
class DepthTargets:
    """Targets of the depth loss for one task. Each panorama is aligned when it is first seen at a width."""

    scene: Scene
    config: DepthConfig
    seed: int
    notices: list[str] = field(default_factory=list)  # of images left out or fitted again, not yet reported
    _aligned: dict[tuple[int, int], Alignment | None] = field(default_factory=dict)  # by row and width
    _noted: set[str] = field(default_factory=set)

    def target(self, view: View) -> tuple[Tensor, Tensor] | None:
        """Target (H, W) inverse radial depth and validity (H, W) bool of a view; None without usable depth.

        Sky is a valid 0: it is where the sky mask says so, without one where the prior is 0. A prior of 0
        that a sky mask calls foreground is a hole; holes and masked pixels are not valid.
        """
        if view.inverse_depth is None or (alignment := self._alignment(view)) is None:
            return None
        prior = inverse_prior(view.inverse_depth, self.config.kind)
        sky = prior <= 0 if view.sky is None else view.sky
        target = torch.where(sky, 0, (alignment.scale * prior + alignment.offset).clamp(min=0))
        valid = sky | (prior > 0)
        return target, valid if view.mask is None else valid & view.mask

    def _align(self, view: View) -> Alignment:
        config = self.config
        return align_depth(
            self.scene,
            view,
            self.seed,
            kind=config.kind,
            min_points=config.min_points,
            max_residual=config.max_residual,
        )

    def _alignment(self, view: View) -> Alignment | None:
        at = view.row, view.image.shape[1]
        if at not in self._aligned:
            name = self.scene.panoramas[view.row].name
            try:
                found = self._aligned[at] = self._align(view)
                if found.note:
                    self._note(f"{name}: {found.note}")
            except AlignmentError as error:
                self._aligned[at] = None
                self._note(f"{name} is left out of the depth loss: {error}")
        return self._aligned[at]

    def _note(self, notice: str) -> None:
        """Once for all widths."""
        if notice not in self._noted:
            self._noted.add(notice)
            self.notices.append(notice)


class Loss:
    """Eq. 6 for the views of one task."""

    def __init__(self, scene: Scene, config: TrainConfig, seed: int, schedule: Schedule) -> None:
        self._config, self._schedule = config.loss, schedule
        self.depth = DepthTargets(scene, config.depth, seed)
        self.unit = scene_length(scene)  # b̂ (eq. 8), world units

    def of(
        self, rendered: Render, view: View, depth_weight: float, around: Baked | None = None
    ) -> tuple[Tensor, Tensor]:
        """The loss as a scalar tensor, and the mean squared error of the colours; on the CPU.

        Args: depth_weight, by `depth_weight`; around, the exterior that was rendered
        with a block: only its active pixels count, with the gradient of the loss of all of them.
        """
        height, width, _ = view.image.shape
        active = None if around is None else around.active(width, height)
        mask, share = _active_part(view.mask, active)
        found = photometric_loss(rendered.color, view.image, mask, self._config.lambda_ssim, self.rows(view))
        loss = found.loss * share
        target = self.depth.target(view) if depth_weight > 0 else None
        if target is not None:
            inverse_depth, valid = target
            share = depth_weight
            if active is not None:
                valid, share = active & valid, share * _share(active, valid)
            loss = loss + share * inverse_depth_loss(rendered.inverse_depth, inverse_depth, valid)
        return loss, found.mse

    def depth_weight(self, iteration: int) -> float:
        """w(t) for inverse depths in units of 1 / b̂ (eq. 8): parallaxes γ = b̂ / z, in radians.

        The paper has none: w_0 would then mean something else for every unit of length of a scene.
        """
        return self._schedule.depth_weight(iteration) * self.unit

    def rows(self, view: View) -> Tensor | None:
        """Weights of the rows of a view."""
        if not self._config.sphere:
            return None
        return sphere_rows(len(view.image), view.mask, view.image.device)


def _active_part(mask: Tensor | None, active: Tensor | None) -> tuple[Tensor | None, float]:
    """Of the pixels of a mask those that are active, and their share of it; None: all pixels.

    A mean over them times the share has the gradient of the mean over the mask: the others are constant.
    """
    if active is None:
        return mask, 1.0
    if mask is None:
        return active, float(active.sum()) / active.numel()
    return active & mask, _share(active, mask)


def _share(active: Tensor, mask: Tensor) -> float:
    return float((active & mask).sum()) / max(int(mask.sum()), 1)
