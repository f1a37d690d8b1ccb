"""The pose of a panorama that fits a finished model best: of held-out ones, whose poses err too."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.losses import photometric_loss
from panolog.renderer.motion import MOTION, MOTION_SUMS, Motion, moved
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import TOE, View
from panolog.workers.capture.poses import Metric

Array = NDArray[np.float64]

STEPS = 24  # renderings and gradients
_FIRST = 1.0  # pixels, the length of the first step
_SHORTER, _LONGER = 0.5, 1.2  # a step that made the loss worse is taken back, and the next one shorter
_LAST = 0.01  # pixels: shorter steps change nothing
_DAMPING = 0.1  # of the moments by their mean
_GAINS = 5  # rounds in which a view's gain is found


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose and how far it is from the one before."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    pixels: float  # root mean square of what it moves what the camera sees by


def fit_steps(
    model: Gaussians,
    view: View,
    rotation: Array,
    translation: Array,
    *,
    points: Array,
    near: float,
    lambda_ssim: float = 0.2,
    gained: bool = False,
) -> Iterator[PoseFit]:
    """Descends along the natural gradient from a pose, (3, 3) and (3,), on the loss of a view.

    Yields the best pose after each rendering, `STEPS` at most.

    Args: model, on the device of the view; points (M, 3), what the camera sees, world units; near, the least
    distance drawn, world units; lambda_ssim as in training; gained, whether a gain of each channel is found
    first, because the panoramas of the model differ in exposure and that of this one is not known.
    """
    width = view.image.shape[1]
    metric = _metric(rotation, translation, points, near)
    inverse, pixel = np.linalg.inv(metric.factor), 2 * np.pi / width
    if gained:
        view = _gained(model, view, Camera.of(rotation, translation, width, width // 2), near)

    def loss(motion: Array) -> tuple[float, Motion]:
        sums = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
        camera = Camera.of(*moved(rotation, translation, motion), width, width // 2)
        color = render(model, camera, near=near, motion=sums.to(model.means.device)).color
        found = photometric_loss(color, view.image, view.mask, lambda_ssim, exposure=view.exposure).loss
        found.backward()  # type: ignore[no-untyped-call]
        assert sums.grad is not None
        return found.item(), Motion.of(sums.grad.numpy())

    def fit() -> PoseFit:
        return PoseFit(*moved(rotation, translation, best), metric.angle(best) / pixel)

    best, length = np.zeros(MOTION), _FIRST
    least, slope = loss(best)
    yield fit()
    for _ in range(STEPS - 1):
        moments = inverse @ slope.moments @ inverse.T
        size = float(np.trace(moments)) / MOTION
        if not size > 0 or length < _LAST:
            break
        along = np.linalg.solve(moments / size + _DAMPING * np.eye(MOTION), inverse @ slope.gradient)
        step = inverse.T @ along * (-length * pixel / max(float(np.linalg.norm(along)), 1e-300))
        value, found = loss(best + step)
        if value < least:
            best, least, slope, length = best + step, value, found, length * _LONGER
        else:
            length *= _SHORTER
        yield fit()


def _gained(model: Gaussians, view: View, camera: Camera, near: float) -> View:
    """The view with the exposure that fits a rendering best: gains in linear light, as `capture.exposure`."""
    with torch.no_grad():
        color = render(model, camera, near=near).color
        factor = torch.ones(3, dtype=torch.float64, device=color.device)
        for _ in range(_GAINS):
            exposure = _affine(factor)
            sums = photometric_loss(color, view.image, view.mask, 0.0, exposure=exposure).exposure
            assert sums is not None
            _, bright, _, error, _ = sums.unbind(1)
            factor = (factor - error / bright.clamp(min=1e-6)).clamp(0.1, 10)
    return replace(view, exposure=_affine(factor))


def _affine(factor: Tensor) -> Tensor:
    """(2, 3) `View.exposure` of factors (3,) of encoded colours."""
    return torch.stack([factor, TOE * (factor - 1)]).float()


def _metric(rotation: Array, translation: Array, points: Array, near: float) -> Metric:
    local = points @ rotation.T + translation
    radius = float(np.median(np.linalg.norm(local, axis=1))) if len(points) else max(10 * near, 1e-9)
    return Metric.of(rotation, translation, points, radius)
