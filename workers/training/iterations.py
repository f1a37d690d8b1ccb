"""Training iterations: on the CPU one by one, on a card some ahead of their results.

The host never waits for all that it launched on a card, only, when it is `AHEAD` iterations ahead, for the
oldest of these. The buffers for pairs of splats and tiles have the size that the same view needed before,
with a margin. Where that was too small, or a loss is not finite, the device skips the step of that iteration
and of all that follow (`renderer.cuda.iteration`). The host then repeats them from that one on: the model is
as if each had been done once, in order.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.cuda import iteration, parts
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.cuda.parts import Launch
from panolog.renderer.iteration import take
from panolog.renderer.motion import MOTION_SUMS
from panolog.scene.errors import RunError
from panolog.scene.tensors.transfer import sleeping_event
from panolog.workers.capture.learning import Learning
from panolog.workers.capture.movers import Visit
from panolog.workers.training.densify import Statistics
from panolog.workers.training.optimizer import ModelState

AHEAD = 3  # iterations: the card stays busy while the host is late once
MARGIN = 1.25  # of the room for pairs over what the view needed last
_UNSEEN = 1.5  # the same for a view without a count, over the most that any view needed
_LEAST = 1024  # pairs


@dataclass(frozen=True, eq=False, kw_only=True)
class Planned:
    """An iteration before it is launched."""

    iteration: int
    view: int  # row of scene.panoramas
    problem: Problem
    state: ModelState
    rates: dict[str, float]
    rows: dict[str, int]  # how many of each parameter move; parameters that are not in it do not
    sizes: tuple[float, float, float]  # as in `ModelState.bound`
    statistics: Statistics | None  # where its screen gradients count
    learning: Learning | None  # of how the view was captured, in Stage I

    def visit(
        self, color: Tensor, inverse_depth: Tensor, exposure: Tensor | None, status: Tensor | None
    ) -> Visit:
        """What it has found."""
        return Visit(
            row=self.view,
            iteration=self.iteration,
            image=self.problem.image,
            color=color,
            affine=self.problem.exposure,
            inverse_depth=inverse_depth,
            status=status,
            exposure=exposure,
        )


class Direct:
    """The iterations of one task on the CPU: each is over when `run` returns."""

    def __init__(
        self, finished: Callable[[float, float], None], broken: Callable[[str, Planned], RunError]
    ) -> None:
        """Args: as those of `Pipeline`."""
        self._finished = finished
        self._broken = broken

    def run(self, planned: Planned) -> None:
        """One iteration. Raises RunError if its loss or a gradient is not finite."""
        problem, counts = planned.problem, planned.statistics is not None
        moving = planned.state.moving(planned.rates, planned.rows)
        try:
            found = take(problem, moving, planned.iteration, screen=counts)
        except FloatingPointError as error:
            raise self._broken(str(error), planned) from error
        planned.state.bound(*planned.sizes)
        seen, loss, learnt = found
        if planned.statistics is not None and learnt.screen is not None:
            visible = seen.state == ops.VISIBLE
            planned.statistics.add(learnt.screen, visible, problem.model["means"], problem.camera)
        if planned.learning is not None:
            planned.learning.step(planned.visit(seen.color, seen.inverse_depth, loss.exposure, None))
            if learnt.motion is not None:
                planned.learning.learn_motion(planned.view, planned.iteration, learnt.motion.numpy())
        self._finished(loss.value, loss.squared)

    def settle(self) -> None:
        """Does nothing, as nothing is in flight: see `Pipeline.settle`."""


@dataclass(frozen=True, eq=False)
class _Launched:
    planned: Planned
    report: Tensor  # (4,) or (31,) float64 on the host, valid when the event is over
    event: torch.cuda.Event | None


class Pipeline:
    """The iterations of one task on one device."""

    def __init__(
        self,
        launch: Launch,
        device: torch.device,
        finished: Callable[[float, float], None],
        broken: Callable[[str, Planned], RunError],
    ) -> None:
        """No iteration is launched.

        Args: finished, receives loss and mean squared error of each iteration, in order; broken, makes the
        error of an iteration from what is not finite.
        """
        self._launch = launch
        self._cuda = device.type == "cuda"
        self._finished = finished
        self._broken = broken
        self._status = iteration.Status(device)
        length = iteration.REPORT + MOTION_SUMS
        self._reports = torch.zeros(AHEAD, length, dtype=torch.float64, pin_memory=self._cuda)
        self._launched: deque[_Launched] = deque()
        self._density: dict[int, float] = {}  # pairs for each Gaussian, by view

    def run(self, planned: Planned) -> None:
        """Launches an iteration; reads those that are over.

        Raises RunError if in one of these a loss or gradient is not finite, or there are more than 2³¹ pairs
        of splats and tiles.
        """
        room = self._room(planned)
        if room is None:
            self._carefully(planned)
            return
        self._enqueue(planned, room)
        while self._launched and (len(self._launched) >= AHEAD or self._over(self._launched[0])):
            self._read()

    def settle(self) -> None:
        """Waits for all that was launched: afterwards the state is that after the last iteration.

        Raises as `run` does.
        """
        while self._launched:
            self._read()

    def _room(self, planned: Planned) -> int | None:
        """Pairs to have room for; None before any count is known."""
        if not self._density:
            return None
        known = self._density.get(planned.view)
        density = _UNSEEN * max(self._density.values()) if known is None else MARGIN * known
        count = len(planned.state.gaussians)
        return min(_LEAST + math.ceil(density * count), parts.MAX_PAIRS)

    def _enqueue(self, planned: Planned, room: int | None) -> None:
        """Launches all of an iteration."""
        moving = planned.state.moving(planned.rates, planned.rows)
        found = iteration.take(self._launch, planned.problem, moving, planned.iteration, self._status, room)
        planned.state.bound(*planned.sizes)
        if planned.statistics is not None:
            into = planned.statistics
            iteration.add_statistics(
                self._launch,
                found,
                self._status,
                planned.problem,
                into.gradient,
                into.views,
                absolute=into.absolute,
                angle=into.config.measure == "angle",
                contribution=into.config.views == "contribution",
            )
        if planned.learning is not None:
            visit = planned.visit(found.color, found.inverse_depth, found.exposure, self._status.known)
            planned.learning.step(visit)
        report = self._reports[planned.iteration % AHEAD, : len(found.report)]
        report.copy_(found.report, non_blocking=True)
        event = sleeping_event() if self._cuda else None
        if event is not None:
            event.record()
        self._launched.append(_Launched(planned, report, event))

    def _over(self, launched: _Launched) -> bool:
        return launched.event is not None and bool(launched.event.query())  # type: ignore[no-untyped-call]

    def _read(self) -> None:
        """Reads the oldest iteration when it is over; repeats it and all later ones if it took no step.

        Raises RunError if it took one by a gradient that is not finite: then the state is invalid.
        """
        plans = [launched.planned for launched in self._launched]
        if (status := self._note()) == 0:
            return
        while self._launched:  # none of them took a step
            self._note()
        self._status.clear()
        if status >= iteration.BROKEN_GRADIENT:
            raise self._broken(iteration.not_finite(status), plans[0])
        self._carefully(plans[0])
        for planned in plans[1:]:
            self.run(planned)

    def _note(self) -> int:
        """Takes the oldest iteration off the list and returns its status."""
        launched = self._launched.popleft()
        if launched.event is not None:
            launched.event.synchronize()
        planned, report = launched.planned, launched.report.numpy()
        loss, squared, pairs, status = report[: iteration.REPORT].tolist()
        self._density[planned.view] = pairs / max(len(planned.state.gaussians), 1)
        if status == 0:
            if planned.learning is not None and planned.problem.moving:
                planned.learning.learn_motion(planned.view, planned.iteration, report[iteration.REPORT :])
            self._finished(loss, squared)
        return int(status)

    def _carefully(self, planned: Planned) -> None:
        """One iteration for which the host waits. Raises RunError with the name of what is not finite."""
        self._enqueue(planned, None)
        if status := self._note():
            self._status.clear()
            raise self._broken(iteration.not_finite(status), planned)
