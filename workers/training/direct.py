"""Training iterations on the CPU: each is over when `run` returns."""

from collections.abc import Callable

import torch

from panolog.renderer.motion import MOTION_SUMS
from panolog.renderer.render import render
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.workers.capture.learning import Observed
from panolog.workers.training.loss import loss_of
from panolog.workers.training.optimizer import finite_loss
from panolog.workers.training.pipeline import Plan


class Direct:
    """The iterations of one task; as `pipeline.Pipeline`, through autograd and without anything in flight."""

    def __init__(
        self, finished: Callable[[float, float], None], broken: Callable[[str, Plan], RunError]
    ) -> None:
        """Args: as those of `Pipeline`."""
        self._finished = finished
        self._broken = broken

    def run(self, plan: Plan) -> None:
        """One iteration. Raises RunError if its loss or a gradient is not finite."""
        problem = plan.problem
        leaves: Gaussians = plan.state.leaves(problem.sh_degree)
        counts = plan.statistics is not None
        screen = torch.zeros(len(leaves), 2, requires_grad=True) if counts else None
        motion = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True) if problem.moving else None
        rendered = render(
            leaves,
            problem.camera,
            sh_degree=problem.sh_degree,
            near=problem.near,
            screen=screen,
            exterior=problem.exterior,
            motion=motion,
        )
        found = loss_of(rendered, problem)
        found.loss.backward()  # type: ignore[no-untyped-call]
        gradients = {n: leaf.grad for n, leaf in leaves.tensors().items() if leaf.grad is not None}
        try:
            value = finite_loss(found.loss)
            plan.state.step(gradients, plan.rates, plan.rows, plan.iteration)
        except FloatingPointError as error:
            raise self._broken(str(error), plan) from error
        if plan.statistics is not None and screen is not None and screen.grad is not None:
            plan.statistics.add(screen.grad, rendered.visible, leaves.means.detach(), problem.camera)
        if plan.learning is not None:
            observed = Observed(
                view=plan.view,
                iteration=plan.iteration,
                image=plan.problem.image,
                color=rendered.color.detach(),
                inverse_depth=rendered.inverse_depth.detach(),
                exposure=found.exposure,
                affine=plan.problem.exposure,
                status=None,
            )
            plan.learning.step(observed)
            if motion is not None and motion.grad is not None:
                plan.learning.learn_motion(plan.view, plan.iteration, motion.grad.numpy())
        self._finished(value, float(found.mse))

    def settle(self) -> None:
        """As `Pipeline.settle`: nothing is in flight."""

    def forget(self) -> None:
        """As `Pipeline.forget`: nothing is kept of a view."""
