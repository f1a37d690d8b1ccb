"""The pose of a panorama that fits a finished model best: of held-out ones, whose poses err too."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.renderer.camera import Camera
from panolog.renderer.losses import photometric_loss
from panolog.renderer.motion import MOTION, MOTION_SUMS, Motion, moved
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View
from panolog.workers.capture.poses import Metric

Array = NDArray[np.float64]

STEPS = 24  # renderings and gradients
_FIRST = 1.0  # pixels, the length of the first step
_SHORTER, _LONGER = 0.5, 1.2  # a step that made the loss worse is taken back, and the next one shorter
_LAST = 0.01  # pixels: shorter steps change nothing
_DAMPING = 0.1  # of the moments by their mean


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose and how far it is from the one before."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    pixels: float  # root mean square of what it moves what the camera sees by


def fit_pose(
    model: Gaussians,
    view: View,
    rotation: Array,
    translation: Array,
    *,
    points: Array,
    near: float,
    lambda_ssim: float = 0.2,
) -> PoseFit:
    """Descends along the natural gradient from a pose, (3, 3) and (3,), on the loss of a view.

    Args: model, on the device of the view; points (M, 3), what the camera sees, world units; near, the least
    distance drawn, world units; lambda_ssim as in training.
    """
    width = view.image.shape[1]
    metric = _metric(rotation, translation, points, near)
    inverse, pixel = np.linalg.inv(metric.factor), 2 * np.pi / width

    def loss(motion: Array) -> tuple[float, Motion]:
        sums = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
        camera = Camera.of(*moved(rotation, translation, motion), width, width // 2)
        color = render(model, camera, near=near, motion=sums.to(model.means.device)).color
        found = photometric_loss(color, view.image, view.mask, lambda_ssim).loss
        found.backward()  # type: ignore[no-untyped-call]
        assert sums.grad is not None
        return float(found), Motion.of(sums.grad.numpy())

    best, length = np.zeros(MOTION), _FIRST
    least, slope = loss(best)
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
    return PoseFit(*moved(rotation, translation, best), metric.angle(best) / pixel)


def _metric(rotation: Array, translation: Array, points: Array, near: float) -> Metric:
    local = points @ rotation.T + translation
    radius = float(np.median(np.linalg.norm(local, axis=1))) if len(points) else max(10 * near, 1e-9)
    return Metric.of(rotation, translation, points, radius)
