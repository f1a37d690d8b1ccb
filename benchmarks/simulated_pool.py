"""Simulated workers: a pool for the driver that sends the messages of tasks by the clock."""

import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.pool import NONE, Ended, Hello, InProcess, Message
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.partition.cells import Cell
from panolog.partition.contraction import expand
from panolog.scene.gaussians import Gaussians
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import Checkpoint, Evaluated, Scored, Trained
from panolog.workers.scoring import ScoreSpec
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import Progress, Stage, TaskId
from panolog.workers.training.initialise import isotropic
from panolog.workers.training.trainer import TrainSpec

SPREAD = 0.2  # by which blocks are shorter or longer than the average
RATES = dict.fromkeys(("means", "quats", "scales", "opacities", "sh0", "shN"), 1e-3)
Timed = tuple[float, Message]  # seconds after the start of the task


@dataclass
class _Running:
    began: float
    messages: Iterator[Timed]
    due: float  # when the next message is sent
    message: Message


class SimulatedPool(InProcess):
    """A pool of one-core workers for `Driver`; returns at most one message of each task at a time."""

    def __init__(self, workers: int, rate: float, seconds: float) -> None:
        """Args: rate, events per second of each block; seconds that a block takes on average."""
        self._nodes = tuple(Node(f"{i:03d}", f"worker-{i}", cpus=1, memory=2**40) for i in range(workers))
        self.sent: Counter[TaskId] = Counter()  # events of progress, by task
        self.late = 0.0  # longest wait of a message of a block, seconds
        self.cpu = 0.0  # seconds used by the simulation itself
        self.turn = 0.0  # most seconds of CPU between two looks for messages, while blocks run
        self._looked = math.inf  # time.thread_time() of the last look at blocks
        self._rate, self._seconds = rate, seconds
        self._random = np.random.default_rng(0)
        self._running: dict[TaskId, _Running] = {}

    def nodes(self) -> tuple[Node, ...]:
        """One node for each worker."""
        return self._nodes

    def notices(self) -> dict[str, LeaveNotice]:
        """These machines announce nothing."""
        return {}

    def start(self, _placement: Placement, spec: TaskSpec) -> None:
        """Simulates a task."""
        now, messages = time.monotonic(), self._messages(spec)
        after, message = next(messages)
        self._running[spec.task] = _Running(now, messages, now + after, message)

    def stop(self, task: TaskId) -> None:
        """Not supported. Raises ValueError."""
        raise ValueError(f"{task} cannot be stopped")

    def waiting(self, _task: TaskId) -> bool:
        """Nothing else uses these machines."""
        return False

    def cancel(self, task: TaskId) -> None:
        """Ends a task."""
        del self._running[task]

    def ready(self, seconds: float, but: Set[TaskId] = NONE) -> list[TaskId]:
        """The tasks, but those in `but`, whose next message is due; waits at most `seconds` for one."""
        began = time.thread_time()
        self.turn = max(self.turn, began - self._looked)
        first = min(
            (task.due for name, task in self._running.items() if name not in but), default=float("inf")
        )
        now = time.monotonic()
        if first > now:
            time.sleep(min(seconds, first - now))
            now = time.monotonic()
        due = [name for name, task in self._running.items() if name not in but and task.due <= now]
        now = time.thread_time()
        self.cpu += now - began
        self._looked = now if any(name.stage is Stage.BLOCK for name in self._running) else math.inf
        return due

    def take(self, name: TaskId) -> Message:
        """The next message of a task that is ready."""
        began, now = time.thread_time(), time.monotonic()
        message = self._take(name, self._running[name], now)
        self.cpu += time.thread_time() - began
        return message

    def _take(self, name: TaskId, task: _Running, now: float) -> Message:
        message = task.message
        self.sent[name] += isinstance(message, Progress)
        if name.stage is Stage.BLOCK:
            self.late = max(self.late, now - task.due)
        if isinstance(message, Ended):
            del self._running[name]
        else:
            after, task.message = next(task.messages)
            task.due = task.began + after
        return message

    def _messages(self, spec: TaskSpec) -> Iterator[Timed]:
        yield 0.0, Hello("simulated", 0)
        after = 0.0
        cell = spec.cell if isinstance(spec, TrainSpec) and isinstance(spec.cell, Cell) else None
        for after, event in _others(spec) if cell is None else self._block(spec.task, cell):
            yield after, event
        yield after, Ended()

    def _block(self, task: TaskId, cell: Cell) -> Iterator[Timed]:
        """Progress by the clock, a checkpoint in the middle, the result with the last."""
        factor = self._random.uniform(1 - SPREAD, 1 + SPREAD)
        count = max(2, round(self._seconds * self._rate * factor))
        for i in range(1, count + 1):
            yield i / self._rate, Progress(task, i, count, self._rate, 0.1, 20.0, 10, 2**30, rates=RATES)
            if i == count // 2:
                yield i / self._rate, Checkpoint(task, i, {"iteration": torch.tensor(i)})
        yield count / self._rate, Trained(task, _middles([cell]), count, count / self._rate)


def _others(spec: TaskSpec) -> Iterator[Timed]:
    """The messages of the tasks that are no blocks, at once."""
    match spec:
        case TrainSpec():
            yield 0.0, Trained(spec.task, _coarse_model(spec), 1, 0.0)
        case EvaluateSpec():
            picture = np.zeros((spec.width // 2, spec.width, 3), np.uint8)
            png = bytes(cv2.imencode(".png", picture)[1])
            for row in spec.views:
                name = spec.scene.load().panoramas[row].name
                yield 0.0, Evaluated(spec.task, name, {"psnr": 20.0}, png)
        case ScoreSpec():
            scores = torch.ones(len(spec.views), spec.blocks, dtype=torch.float64)
            yield 0.0, Scored(spec.task, spec.views, scores)


def _coarse_model(spec: TrainSpec) -> Gaussians:
    """A Stage I model with one Gaussian in each block."""
    config, scene = spec.config, spec.scene.load()
    if not isinstance(config, RunConfig):
        raise TypeError(f"{spec.task} is not of a run")
    box = config.partition.box(scene.centers[list(scene.train)])
    return _middles([Cell(box, config.grid, block) for block in range(config.grid.count)])


def _middles(cells: Sequence[Cell]) -> Gaussians:
    """A Gaussian in the middle of each cell."""
    points = [expand([np.mean(cell.grid.bounds(cell.block), axis=0)], cell.aabb) for cell in cells]
    means = np.concatenate(points)
    return isotropic(means, np.ones(len(means)), np.full((len(means), 3), 0.5), 0.1)
