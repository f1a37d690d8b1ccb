"""Gradient scores: the influence of each block on the loss of each camera (eq. 10)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.camera import Camera
from panolog.renderer.losses import PhotometricLoss, photometric_loss
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View
from panolog.scene.model import Scene
from panolog.workers.events import Event, Scored
from panolog.workers.meter import Meter
from panolog.workers.sound_views import SoundViews, open_cache
from panolog.workers.specs import Source, TaskSpec
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.initialise import near_distance
from panolog.workers.training.loss import loss_rows

_MOST, _MOST_NEAR = 64, 16  # cameras of a shard
T = TypeVar("T")


def shards_of(cameras: tuple[int, ...], reduces: bool) -> tuple[tuple[int, ...], ...]:
    """Cameras as they are scored or measured. A function of what a run begins with, so shards stay valid.

    Args: reduces, `Stage2Config.reduces`: few cameras, near each other, then need less of the place.
    """
    size = min(_MOST_NEAR if reduces else _MOST, max(4, len(cameras) // 16))
    return in_shards(cameras, size)


def in_shards(items: tuple[T, ...], most: int) -> tuple[tuple[T, ...], ...]:
    """Runs of neighbours of nearly equal length: as few as have no more than `most` items, none empty."""
    shards = -(-len(items) // most)
    edges = [len(items) * i // shards for i in range(shards + 1)] if shards else []
    return tuple(items[a:b] for a, b in pairwise(edges))


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoreSpec(TaskSpec):
    """Scores a shard of the training cameras with the model of Stage I."""

    views: tuple[int, ...]  # rows of scene.panoramas
    model: Source[Gaussians]  # N, the model of Stage I or what the views distinguish of it, sky last
    labels: Source[NDArray[np.int64]]  # (N - sky,) block of each scene Gaussian, 0 to `blocks` - 1
    blocks: int
    config: TrainConfig
    sizes: tuple[int, ...] | None = None  # (blocks,) Gaussians that each block's stand for; None = themselves

    def run(self) -> Iterator[Event]:
        """One forward and backward pass for each view; yields Progress and at last Scored (eq. 10).

        The rendering loss L_k is the photometric part of eq. 6. The depth part is left out: it measures the
        prior, not what the camera sees; its weight has decayed to w_T by the end of Stage I; and images that
        have no usable prior would be scored by another measure than the others.

        A panorama that cannot be decoded is left out: its scores are 0, so geometry alone assigns it.
        There is no limit, so that only the blocks with too many of them fail; unless `images.damaged` is 0.

        Raises InputError if an image cannot be read or too many cannot be decoded, RunError if a gradient is
        not finite, ValueError unless the labels are one block for each scene Gaussian.
        """
        scene, labels = self.scene.load(), self.labels.load()
        model = self.model.load().to(self.device)
        _check_labels(labels, model, self)
        model = replace(model, means=model.means.detach().clone().requires_grad_())
        near = near_distance(scene, self.config)
        meter = Meter(self.task, len(self.views), self.device)
        scores = _Scores(self, scene, labels, meter)
        budget = int(self.config.cache.memory * 2**30)  # each view is used once: none stays on a GPU
        with open_cache(self, scene, self.views, budget) as cache:
            damaged = 1.0 if self.config.images.damaged else 0.0  # in training each block has its limit
            views = SoundViews(self.task, scene, self.views, cache, damaged)
            for k, row in enumerate(self.views):
                cache.prefetch(self.views[k + 1 : k + 1 + cache.ahead(2)])
                if (view := views.get(row)) is not None:
                    scores.add(k, *_gradient(self, scene, model, view, near))
                yield from views.notices()
                if meter.due() or k + 1 == len(self.views):
                    scores.read()
                    yield meter.progress(k + 1, len(model))
        yield Scored(self.task, self.views, scores.values.cpu())


def _check_labels(labels: NDArray[np.int64], model: Gaussians, spec: ScoreSpec) -> None:
    if labels.shape != (len(model) - model.sky,):
        raise ValueError(f"task {spec.task}: {labels.shape} labels for {len(model)} Gaussians")
    if len(labels) and not (labels.min() >= 0 and labels.max() < spec.blocks):
        raise ValueError(f"task {spec.task}: labels must be blocks, 0 to {spec.blocks - 1}")


class _Scores:
    """The scores of the views so far: on the device, from which the host reads only when it reports."""

    def __init__(self, spec: ScoreSpec, scene: Scene, labels: NDArray[np.int64], meter: Meter) -> None:
        """Zeros."""
        device = torch.device(spec.device)
        held = np.bincount(labels, minlength=spec.blocks) if spec.sizes is None else np.array(spec.sizes)
        sizes = np.maximum(held, 1)
        self.values = torch.zeros(len(spec.views), spec.blocks, dtype=torch.float64, device=device)
        self._spec, self._scene, self._meter = spec, scene, meter
        self._labels = torch.from_numpy(labels).to(device)
        self._sizes = torch.from_numpy(sizes.astype(np.float64)).to(device)
        self._unread: list[tuple[int, Tensor]] = []  # views with (2 + blocks,) loss, squared error, scores
        self._late = ops.launcher(device) is not None

    def add(self, k: int, loss: PhotometricLoss, gradient: Tensor) -> None:
        """Eq. 10 for view k; on the CPU raises as `read`.

        Args: gradient (N - sky, 3) of its loss by the means.
        """
        x, y, z = gradient.double().abs().unbind(1)
        row = self.values[k].index_add_(0, self._labels, x + y + z).div_(self._sizes)
        self._unread.append((k, torch.cat([torch.stack([loss.loss.detach(), loss.mse]), row])))
        if not self._late:
            self.read()

    def read(self) -> None:
        """Counts the losses of the views since the last call. Raises RunError if a gradient is not finite."""
        unread, self._unread = self._unread, []
        if not unread:
            return
        content = torch.stack([values for _, values in unread]).tolist()
        for (k, _), (loss, squared, *row) in zip(unread, content, strict=True):
            if not all(map(math.isfinite, row)):
                name = self._scene.panoramas[self._spec.views[k]].name
                raise RunError(f"{self._spec.task}: {name} has a gradient that is not finite")
            self._meter.count(loss, squared)


def _gradient(
    spec: ScoreSpec, scene: Scene, model: Gaussians, view: View, near: float
) -> tuple[PhotometricLoss, Tensor]:
    """The rendering loss of one view, and its gradient by the means (N - sky, 3)."""
    camera = Camera.at(scene.panoramas[view.row], spec.width)
    color = render(model, camera, sh_degree=spec.config.sh.degree, near=near).color
    rows, weight = loss_rows(spec.config.loss, view), spec.config.loss.lambda_ssim
    loss = photometric_loss(color, view.image, view.mask, weight, rows, view.exposure)
    (gradient,) = torch.autograd.grad(loss.loss, model.means)
    return loss, gradient[model.scene]
