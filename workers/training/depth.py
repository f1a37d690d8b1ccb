"""Depth supervision: the target of the depth loss (eq. 5), from depth maps aligned by eq. 4."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from panolog.scene.depth_alignment import Alignment, AlignmentError, align_depth, inverse_prior
from panolog.scene.images import View
from panolog.scene.model import Scene
from panolog.workers.training.config import DepthConfig


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
