"""One training iteration, in parts and as a whole."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import fmean, median

import torch
from torch import Tensor

from benchmarks.rasterizer.cases import Case, TrainingView
from panolog.renderer import _core, ops
from panolog.renderer.adam import BETAS, EPSILON
from panolog.renderer.cuda.iteration import Problem, gradients
from panolog.renderer.cuda.parts import Launch, adam_step
from panolog.renderer.losses import photometric_loss
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import Gaussians
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.optimizer import ModelState, finite_loss

SH_DEGREE = 3


@dataclass(frozen=True)
class Times:
    """Milliseconds of the parts of an iteration, and of a whole one measured separately."""

    forward: float
    loss: float
    backward: float
    adam: float
    iteration: float

    @property
    def rasterization(self) -> float:
        """Forward and backward, in milliseconds."""
        return self.forward + self.backward

    @property
    def share(self) -> float:
        """The fraction of the parts that is rasterization."""
        return self.rasterization / (self.rasterization + self.loss + self.adam)


@dataclass(frozen=True)
class Stages:
    """Milliseconds within forward and backward on the CPU."""

    project: float  # with spherical harmonics
    order: float  # by depth, then into tiles
    composite: float
    composite_backward: float
    project_backward: float


class TrainingStep:
    """The steps of a training iteration on one view, as in `workers.training.trainer`.

    The learning rates are zero, so that every repetition has the same Gaussians.
    """

    def __init__(self, case: Case, view: TrainingView) -> None:
        self.near = case.near
        self.view = view
        self.state = ModelState.start(case.gaussians)
        self.rates = dict.fromkeys(case.gaussians.tensors(), 0.0)
        self.rows = dict.fromkeys(case.gaussians.tensors(), len(case.gaussians))
        self.room: int | None = None  # for pairs of splats and tiles, on a card after the first iteration

    def forward(self) -> tuple[Gaussians, Render]:
        """The leaves and their image."""
        leaves = self.state.leaves(SH_DEGREE)
        screen = leaves.means.new_zeros(len(leaves), 2).requires_grad_()
        rendered = render(
            leaves,
            self.view.camera,
            sh_degree=SH_DEGREE,
            near=self.near,
            screen=screen,
            exterior=self.view.around,
        )
        return leaves, rendered

    def loss(self, color: Tensor) -> Tensor:
        """Eq. 6 without depth; color (H, W, 3)."""
        mask, share = self.active()
        loss = photometric_loss(color, self.view.target, mask, TrainConfig().loss.lambda_ssim).loss
        return loss if share is None else loss * share

    def active(self) -> tuple[Tensor, Tensor] | tuple[None, None]:
        """Within an exterior the (H, W) pixels that count and their share, as `Loss.targets` finds them."""
        if self.view.around is None:
            return None, None
        mask = self.view.around.active(self.view.camera.width, self.view.camera.height)
        return mask, mask.sum(dtype=torch.float64) / mask.numel()

    def adam(self, leaves: Gaussians, loss: Tensor) -> None:
        """The check that all values are finite, and the step."""
        found = {name: leaf.grad for name, leaf in leaves.tensors().items() if leaf.grad is not None}
        finite_loss(loss)
        self.state.step(found, self.rates, self.rows, step=1)

    def iteration(self) -> None:
        """A whole iteration, on a card as in `workers.training.pipeline`."""
        launch = ops.launcher(self.view.target.device)
        if launch is not None:
            self._on_card(launch)
            return
        leaves, rendered = self.forward()
        loss = self.loss(rendered.color)
        loss.backward()  # type: ignore[no-untyped-call]
        self.adam(leaves, loss)

    def _on_card(self, launch: Launch) -> None:
        mask, share = self.active()
        problem = Problem(
            model=self.state.gaussians.tensors(),
            camera=self.view.camera,
            image=self.view.target,
            mask=mask,
            share=share,
            exterior=self.view.around,
            depth=None,
            depth_weight=0.0,
            lambda_ssim=TrainConfig().loss.lambda_ssim,
            rows=None,
            sh_degree=SH_DEGREE,
            near=self.near,
            exact=self.state.gaussians.exact,
        )
        status = torch.zeros(1, dtype=torch.int32, device=self.view.target.device)
        found = gradients(launch, problem, status, self.room)
        if self.room is None:
            self.room = int(1.25 * float(found.report[2])) + 1
        updates = self.state.updates(found.gradients, self.rates, self.rows)
        adam_step(launch, updates, *BETAS, EPSILON, 1, status)

    def rasterize(self) -> None:
        """Forward and backward alone, with a gradient of ones."""
        _, rendered = self.forward()
        rendered.color.backward(torch.ones_like(rendered.color))  # type: ignore[no-untyped-call]

    def parts(self) -> Iterator[float]:
        """Seconds of forward, loss with its gradient, backward and Adam of one iteration."""
        start = self.now()
        leaves, rendered = self.forward()
        yield self.now() - start
        start = self.now()
        color = rendered.color.detach().requires_grad_()
        loss = self.loss(color)
        loss.backward()  # type: ignore[no-untyped-call]
        yield self.now() - start
        start = self.now()
        rendered.color.backward(color.grad)  # type: ignore[no-untyped-call]
        yield self.now() - start
        start = self.now()
        self.adam(leaves, loss)
        yield self.now() - start

    def now(self) -> float:
        """Seconds on a clock, read after the device has finished its work."""
        if self.view.target.is_cuda:
            torch.cuda.synchronize()
        return time.perf_counter()


def measure(case: Case, threads: int, repeats: int) -> Times:
    """Medians over `repeats` after a warm-up, means over the views; on the device of the case."""
    ops.use_threads(threads)
    medians = []
    for view in case.views:
        step = TrainingStep(case, view)
        step.iteration()  # warm-up: pages, caches, kernels compiled on first use
        parts = zip(*(tuple(step.parts()) for _ in range(repeats)), strict=True)
        whole = [_seconds(step, step.iteration) for _ in range(repeats)]
        medians.append([median(part) * 1e3 for part in (*parts, whole)])
    return Times(*(fmean(part) for part in zip(*medians, strict=True)))


def _seconds(step: TrainingStep, work: Callable[[], None]) -> float:
    start = step.now()
    work()
    return step.now() - start


def stages(case: Case, threads: int, repeats: int) -> Stages:
    """As `measure`, on the CPU: the parts of forward and backward."""
    ops.use_threads(threads)
    medians = []
    for view in case.views:
        step = TrainingStep(case, view)
        found = []
        for _ in range(repeats + 1):
            step.rasterize()
            found.append(_core.stages())
        medians.append([median(stage) * 1e3 for stage in zip(*found[1:], strict=True)])
    return Stages(*(fmean(stage) for stage in zip(*medians, strict=True)))
