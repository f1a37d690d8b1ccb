"""One training iteration, in parts and as a whole."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import fmean, median

import torch
from torch import Tensor

from benchmarks.rasterizer.cases import Case, TrainingView
from panolog.renderer import _core, ops
from panolog.renderer.adam import Moving
from panolog.renderer.cuda import iteration as cuda
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.iteration import backward, forward, loss_of, take
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import Gaussians
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.optimizer import ModelState

SH_DEGREE = 3


@dataclass(frozen=True)
class Times:
    """Milliseconds of the parts of an iteration, and of a whole one measured separately."""

    forward: float
    loss: float
    backward: float  # with the step of Adam, which is a part of it
    iteration: float

    @property
    def rasterization(self) -> float:
        """Forward and backward, in milliseconds."""
        return self.forward + self.backward

    @property
    def share(self) -> float:
        """The fraction of the parts that is rasterization and Adam."""
        return self.rasterization / (self.rasterization + self.loss)


@dataclass(frozen=True)
class Stages:
    """Milliseconds within forward and backward on the CPU."""

    project: float  # with spherical harmonics
    order: float  # by depth, then into tiles
    composite: float
    composite_backward: float
    project_backward: float  # with the step of Adam


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

    def problem(self) -> Problem:
        """The iteration's model and image, without depth."""
        mask, share = self.active()
        return Problem(
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

    def active(self) -> tuple[Tensor, Tensor] | tuple[None, None]:
        """Within an exterior the (H, W) pixels that count and their share, as `Loss.targets` finds them."""
        if self.view.around is None:
            return None, None
        mask = self.view.around.active(self.view.camera.width, self.view.camera.height)
        return mask, mask.sum(dtype=torch.float64) / mask.numel()

    def moving(self) -> dict[str, Moving]:
        """What Adam moves: everything."""
        return self.state.moving(self.rates, self.rows)

    def iteration(self) -> None:
        """A whole iteration, as in `workers.training.iterations`."""
        launch, problem = ops.launcher(self.view.target.device), self.problem()
        if launch is None:
            take(problem, self.moving(), 1, screen=True)
            return
        found = cuda.take(launch, problem, self.moving(), 1, cuda.Status(self.view.target.device), self.room)
        if self.room is None:
            self.room = int(1.25 * float(found.report[2])) + 1

    def forward(self) -> tuple[Gaussians, Render]:
        """The model as leaves of autograd, and its image."""
        model = self.state.gaussians
        leaves = model.with_tensors({n: it.detach().requires_grad_() for n, it in model.tensors().items()})
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

    def rasterize(self) -> None:
        """Forward and backward pass through autograd, with a gradient of ones."""
        _, rendered = self.forward()
        rendered.color.backward(torch.ones_like(rendered.color))  # type: ignore[no-untyped-call]

    def parts(self) -> Iterator[float]:
        """Seconds of forward, loss with its gradient, and backward with Adam of one iteration."""
        passes = self._passes()
        for _ in range(3):
            start = self.now()
            next(passes)
            yield self.now() - start

    def _passes(self) -> Iterator[None]:
        """Takes one iteration in its three parts, each when the next item is requested."""
        launch, problem, moving = ops.launcher(self.view.target.device), self.problem(), self.moving()
        if launch is None:
            seen = forward(problem)
            yield
            loss = loss_of(problem, seen.color, seen.inverse_depth)
            yield
            backward(problem, seen, loss, moving, 1, screen=True)
            yield
            return
        status = cuda.Status(self.view.target.device)
        there = cuda.forward(launch, problem, self.room)
        yield
        found = cuda.loss_of(launch, problem, there, status)
        yield
        cuda.backward(launch, problem, there, found, moving, 1, status)
        yield

    def now(self) -> float:
        """Seconds on a clock, read after the device has finished its work."""
        if self.view.target.is_cuda:
            torch.cuda.synchronize()
        return time.perf_counter()

    def milliseconds(self, work: Callable[[], object], repeats: int) -> float:
        """How long some work takes: the median of the repetitions after a warm-up."""
        work()
        took = []
        for _ in range(repeats):
            start = self.now()
            work()
            took.append(self.now() - start)
        return median(took) * 1e3


def measure(case: Case, threads: int, repeats: int) -> Times:
    """Medians over `repeats` after a warm-up, means over the views; on the device of the case."""
    ops.use_threads(threads)
    medians = []
    for view in case.views:
        step = TrainingStep(case, view)
        whole = step.milliseconds(step.iteration, repeats)  # warms up: pages, caches, kernels
        parts = zip(*(tuple(step.parts()) for _ in range(repeats)), strict=True)
        medians.append([*(median(part) * 1e3 for part in parts), whole])
    return Times(*(fmean(part) for part in zip(*medians, strict=True)))


def stages(case: Case, threads: int, repeats: int) -> Stages:
    """As `measure`, on the CPU: the parts of forward and backward."""
    ops.use_threads(threads)
    medians = []
    for view in case.views:
        step = TrainingStep(case, view)
        found = []
        for _ in range(repeats + 1):
            step.iteration()
            found.append(_core.stages())
        medians.append([median(stage) * 1e3 for stage in zip(*found[1:], strict=True)])
    return Stages(*(fmean(stage) for stage in zip(*medians, strict=True)))
