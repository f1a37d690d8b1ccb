"""The simulated machines: a pool for the driver, on a clock that jumps from tick to tick."""

import os
import time
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.driver_scale.simulated_pool import coarse_model, middles, others
from benchmarks.three_days import attempts
from benchmarks.three_days.attempts import Attempt, Place, Timed
from benchmarks.three_days.faults import NEVER, Plan
from benchmarks.three_days.load import GPUS, Load
from panolog.orchestrator.resources.leaving import LeaveNotice
from panolog.orchestrator.resources.nodes import Gpu, Node, Placement
from panolog.orchestrator.resources.pool import Ended, Failed, Hello, InProcess, Message
from panolog.orchestrator.run.state import ignore
from panolog.partition.cells import Cell
from panolog.scene.gaussians import Gaussians
from panolog.workers.events import Checkpoint, Preview, Scored, Trained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from panolog.workers.training.trainer import TrainSpec

CORES = 32  # of each machine
MEMORY = 128 * 2**30  # bytes, likewise
COARSE = 0.015  # of the run: Stage I, on one GPU
_LOGGED = (Hello, Checkpoint, Preview, Trained, Scored, Ended, Failed)


class VirtualClock:
    """A `Clock` that stands still while the driver works."""

    def __init__(self, epoch: float, now: float) -> None:
        """Args: epoch, the start of the run in seconds since 1970; now, seconds since then."""
        self._epoch, self.now = epoch, now
        self.on_tick: Callable[[], None] = ignore  # called after each jump

    def time(self) -> float:
        """Seconds since 1970."""
        return self._epoch + self.now

    def monotonic(self) -> float:
        """Seconds since the start of the run."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Lets so much time pass at once, at least a second: a driver that waits for its disk looks often."""
        self.jump(self.now + max(1.0, seconds))

    def jump(self, time: float) -> None:
        """To a later time."""
        self.now = time
        self.on_tick()


@dataclass
class _Running:
    placement: Placement
    messages: Iterator[Timed]
    attempt: Attempt | None  # None if it does not train
    due: float
    message: Message


class SimulatedCluster(InProcess):
    """A pool of machines with GPUs for `Driver`. What it delivers is in a log at once, line by line."""

    def __init__(self, clock: VirtualClock, load: Load, plan: Plan, log: Path) -> None:
        self.cpu = 0.0  # seconds used by the simulation itself
        self.messages = 0  # delivered
        self.on_message: Callable[[Message], None] = ignore  # called with each, when it is in the log
        self._clock, self._load, self._plan = clock, load, plan
        self._seconds = load.block_seconds(plan.speed)
        self._places: dict[str, Place] = {}  # by node, of GPU 0
        self._running: dict[TaskId, _Running] = {}
        self._log = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC)
        self._nodes = self._listed()

    @property
    def running(self) -> int:
        """Tasks."""
        return len(self._running)

    def nodes(self) -> tuple[Node, ...]:
        """The machines that Ray lists now."""
        return self._nodes

    def notices(self) -> dict[str, LeaveNotice]:
        """These machines announce nothing."""
        return {}

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        """Simulates a task. Raises RuntimeError if it runs already, or if its GPU has another."""
        began = time.thread_time()
        place, now = self._place(placement), self._clock.now
        where = placement.node, placement.gpu
        used = sum(r.placement.gpus for r in self._running.values() if _where(r) == where)
        if spec.task in self._running or used + placement.gpus > 1:
            raise RuntimeError(f"{spec.task} on {where}: started twice, or on a GPU that is taken")
        attempt = self._attempt(spec, place) if isinstance(spec, TrainSpec) else None
        random = np.random.default_rng([self._load.seed, 4, int(now), spec.task.index or 0])
        work: Iterator[Timed]
        if attempt is None:
            fault = attempts.node_fault(place, now)
            work = ((now + attempts.START_S + after, event) for after, event in others(spec))
        else:
            fault = attempts.first_of(attempt, self._plan, random)
            work = attempt.work(self._result(attempt.spec))
        messages = attempts.messages(work, fault, place, now)
        due, message = next(messages)
        self._running[spec.task] = _Running(placement, messages, attempt, due, message)
        self._write(spec.task, "start", attempt.first if attempt else 0, place.host.name, place.gpu)
        self.cpu += time.thread_time() - began

    def stop(self, task: TaskId) -> None:
        """The task sends a checkpoint and ends."""
        running, now = self._running[task], self._clock.now
        if running.attempt is None or running.due == NEVER:  # a hung one does not
            return
        running.messages = iter([(now + 2.0, Ended())])
        running.due, running.message = now + 1.0, running.attempt.checkpoint(now)

    def cancel(self, task: TaskId) -> None:
        """Ends a task by force."""
        del self._running[task]
        self._write(task, "cancelled")

    def waiting(self, _task: TaskId) -> bool:
        """Nothing else uses these machines."""
        return False

    def ready(self, seconds: float, but: Set[TaskId] = frozenset()) -> list[TaskId]:
        """The tasks, but those in `but`, that have a message; else those of the next tick, if it may wait."""
        due = self._due(but)
        if not due and seconds:
            tick = self._load.tick
            self._clock.jump((self._clock.now // tick + 1) * tick)
            began = time.thread_time()
            self._nodes = self._listed()
            due = self._due(but)
            self.cpu += time.thread_time() - began
        return due

    def take(self, task: TaskId) -> Message:
        """The next message of a task that is ready."""
        began = time.thread_time()
        running = self._running[task]
        message = running.message
        self.messages += 1
        if isinstance(message, _LOGGED):
            value = message.iteration if isinstance(message, Checkpoint | Preview) else 0
            reason = message.reason if isinstance(message, Failed) else ""
            self._write(task, type(message).__name__, value, reason)
        if isinstance(message, Ended | Failed):
            del self._running[task]
        else:
            running.due, running.message = next(running.messages)
        self.on_message(message)
        self.cpu += time.thread_time() - began
        return message

    def _due(self, but: Set[TaskId]) -> list[TaskId]:
        now = self._clock.now
        return [task for task, running in self._running.items() if running.due <= now and task not in but]

    def _listed(self) -> tuple[Node, ...]:
        now, nodes = self._clock.now, []
        for host in self._plan.hosts:
            if (number := host.node(now)) is not None:
                name = f"{host.name}-{number}"
                self._places[name] = Place(host, number, 0)
                gpus = tuple(Gpu(host.gpu, host.memory, f"{name}-{gpu}") for gpu in range(GPUS))
                nodes.append(Node(name, host.name, CORES, MEMORY, gpus))
        return tuple(nodes)

    def _place(self, placement: Placement) -> Place:
        first = self._places[placement.node]
        return Place(first.host, first.node, placement.gpu or 0)

    def _attempt(self, spec: TrainSpec, place: Place) -> Attempt:
        first = 0 if spec.checkpoint is None else spec.checkpoint.load().iteration
        seconds = self._load.seconds * COARSE
        if spec.task.index is not None:
            seconds = self._seconds[spec.task.number] * place.host.slowness
        return Attempt(spec, place, self._clock.now, seconds, first, self._load)

    def _result(self, spec: TrainSpec) -> Gaussians:
        if not isinstance(spec.cell, Cell):
            return coarse_model(spec, self._load.gaussians)
        return middles([spec.cell], [self._load.gaussians[spec.cell.block]])

    def _write(self, task: TaskId, kind: str, value: int = 0, *detail: object) -> None:
        """One line: it is in the file even if this process is killed next."""
        words = (f"{self._clock.now:.1f}", task, kind, value, *detail)
        os.write(self._log, ("\t".join(map(str, words)) + "\n").encode())


def _where(running: _Running) -> tuple[str, int | None]:
    return running.placement.node, running.placement.gpu
