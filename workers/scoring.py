"""Gradient scores: how much each block matters to each camera (eq. 10)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.losses import PhotometricLoss, photometric_loss
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache, View
from panolog.scene.model import Scene
from panolog.workers.events import Event, Scored
from panolog.workers.meter import Meter
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import near_distance


@dataclass(frozen=True, eq=False)
class ScoreTask:
    """A shard of the training cameras to score with the model of Stage I.

    Raises ValueError unless `labels` has one block, 0 to `blocks` - 1, for each scene Gaussian.
    """

    name: str  # "score/000"
    scene: Scene
    views: tuple[int, ...]  # rows of scene.panoramas
    width: int  # pixels, as in training; height is width / 2
    gaussians: Gaussians  # N, the full model of Stage I, sky last
    labels: NDArray[np.int64]  # (N - sky,) block of each scene Gaussian
    blocks: int
    config: TrainConfig
    device: str = "cpu"
    locate: Locate = here  # where the panoramas are

    def __post_init__(self) -> None:
        if self.labels.shape != (len(self.gaussians) - self.gaussians.sky,):
            raise ValueError(
                f"task {self.name}: {self.labels.shape} labels for {len(self.gaussians)} Gaussians"
            )
        if len(self.labels) and not (self.labels.min() >= 0 and self.labels.max() < self.blocks):
            raise ValueError(f"task {self.name}: labels must be blocks, 0 to {self.blocks - 1}")


def score(task: ScoreTask) -> Iterator[Event]:
    """One forward and backward pass for each view; yields Progress and at last Scored (eq. 10).

    The rendering loss L_k is the photometric part of eq. 6. The depth part is left out: it says where a prior
    disagrees, not what the camera sees; its weight has decayed to w_T by the end of Stage I; and images that
    have no usable prior would be scored by another measure than the rest.

    Raises InputError if an image cannot be read, RunError if a gradient is not finite.
    """
    model = task.gaussians.to(task.device)
    model = replace(model, means=model.means.detach().clone().requires_grad_())
    near = near_distance(task.scene, task.config)
    sizes = np.bincount(task.labels, minlength=task.blocks)
    scores = np.zeros((len(task.views), task.blocks))
    meter = Meter(task.name, len(task.views), task.device)
    budget = int(task.config.cache.memory * 2**30)
    with PanoramaCache(task.scene, task.views, task.width, budget, task.locate) as cache:
        for k, row in enumerate(task.views):
            cache.prefetch(task.views[k + 1 : k + 3])
            loss, gradient = _position_gradient(task, model, cache.get(row), near)
            magnitude = np.abs(gradient[model.scene].cpu().numpy().astype(np.float64)).sum(axis=1)
            if not np.isfinite(magnitude).all():
                raise RunError(
                    f"{task.name}: {task.scene.panoramas[row].name} has a gradient that is not finite"
                )
            sums = np.bincount(task.labels, weights=magnitude, minlength=task.blocks)
            scores[k] = sums / np.maximum(sizes, 1)
            meter.count(float(loss.loss.detach()), float(loss.mse))
            if meter.due() or k + 1 == len(task.views):
                yield meter.progress(k + 1, len(model), {})
    yield Scored(task.name, task.views, torch.from_numpy(scores))


def _position_gradient(
    task: ScoreTask, model: Gaussians, view: View, near: float
) -> tuple[PhotometricLoss, Tensor]:
    """The rendering loss of one view and its (N, 3) gradient with respect to the means."""
    panorama = task.scene.panoramas[view.row]
    camera = Camera.of(panorama.rotation, panorama.translation, task.width, task.width // 2).to(task.device)
    color = render(model, camera, sh_degree=task.config.sh.degree, near=near).color
    mask = None if view.mask is None else view.mask.to(task.device)
    loss = photometric_loss(color, view.image.to(task.device), mask, task.config.loss.lambda_ssim)
    (gradient,) = torch.autograd.grad(loss.loss, model.means)
    return loss, gradient
