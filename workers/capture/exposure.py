"""The exposure of each panorama, learnt in Stage I: gains in linear light.

With sRGB's curve, a gain g in linear light maps an encoded value x to a·(x + k) - k with a = g^(1/2.4) and
k = 0.055, exactly above its short linear part. So log g has one meaning at all brightnesses, and the rendered
image needs an affine map only, which the loss applies (`renderer.losses.photometric_loss`).

A step is Gauss-Newton on the view's own robust squared error: normal equations come from the same pass as
the loss. After each, log gains are projected so that their mean over the views is what it was at the start:
no brightness can move between the exposures and the scene.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.scene.images import CURVE, exposure_affine
from panolog.scene.model import Scene
from panolog.workers.capture.config import ExposureConfig

_NAME, _VISITS = "exposure.values", "exposure.visits"  # in checkpoints
_SLOWEST = 0.05  # of a step, in long runs
_MOST = 1.5  # natural logarithm: a view may be 4.5 times as bright as the seed says, or as dark
_LEAST = 1e-6  # squared: below it the view is black and says nothing of a gain


class Exposures:
    """The exposures of the views of one task."""

    def __init__(self, start: Tensor, views: Sequence[int]) -> None:
        """Args: start (V, 2, 3) float64, `Panorama.exposure` of each of the views, on the device."""
        self._at = {row: at for at, row in enumerate(views)}
        self._start = start
        self._values = start.clone()
        self._visits = torch.zeros(len(views), dtype=torch.float64, device=start.device)

    @staticmethod
    def of(scene: Scene, views: Sequence[int], config: ExposureConfig, device: str) -> "Exposures | None":
        """None if they are not learnt: so "auto" has it where no panorama has an exposure to begin with."""
        known = [scene.panoramas[row].exposure for row in views]
        if config.learn is False or (config.learn == "auto" and all(value is None for value in known)):
            return None
        start = np.stack([np.zeros((2, 3)) if value is None else value for value in known])
        return Exposures(torch.from_numpy(start).to(device), views)

    def of_view(self, row: int) -> Tensor:
        """(2, 3) float32 factors and summands of a view's colours: `View.exposure`."""
        return exposure_affine(self._values[self._at[row]])

    def step(self, row: int, sums: Tensor, status: Tensor | None) -> None:
        """Learns from the normal equations of a view.

        Args: sums (3, 5) float64 of each channel over the pixels that count, with Huber's weights w: w, w·s,
        w·s², w·r and w·s·r, of the errors r and s = x + k; status (1,): nothing is learnt unless it is 0.
        """
        at = self._at[row]
        factor = torch.exp(self._values[at, 0] / CURVE)
        _, s, _, r, _ = sums.unbind(1)
        by_factor = -r / s.clamp(min=_LEAST)
        rate = (2 / (3 + self._visits[at])).clamp(min=_SLOWEST)  # late visits even out each other's noise
        values = self._values.clone()
        values[at, 0].add_((CURVE * by_factor / factor * rate).clamp(-0.5, 0.5))
        learnt = values[:, 0] - self._start[:, 0]
        learnt = (learnt - learnt.mean(0)).clamp(-_MOST, _MOST)
        values = torch.stack([self._start[:, 0] + learnt, values[:, 1]], dim=1)
        taken = torch.isfinite(values).all()
        if status is not None:
            taken &= status[0] == 0
        self._values = torch.where(taken, values, self._values)
        self._visits[at].add_(taken)

    def learnt(self) -> NDArray[np.float64]:
        """(V, 2, 3) `Panorama.exposure` of each view."""
        values: NDArray[np.float64] = self._values.cpu().numpy().copy()
        return values

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {_NAME: self._values, _VISITS: self._visits}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """The inverse of `tensors`; of a checkpoint without them, the start."""
        if _NAME in tensors:
            self._values = tensors[_NAME].to(self._start.device, copy=True)
            self._visits = tensors[_VISITS].to(self._start.device, copy=True)
