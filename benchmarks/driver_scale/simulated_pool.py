"""Simulated workers: a pool for the driver that sends the messages of tasks by the clock."""

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from panolog.orchestrator.resources.messages import Ended, Hello, Message
from panolog.orchestrator.resources.nodes import Node, Place
from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.partition.contraction import expand
from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians
from panolog.workers.events import Checkpoint, Evaluated, Progress, Scored, Trained
from panolog.workers.training.initialise import isotropic

SPREAD = 0.2  # by which blocks are shorter or longer than the average
_RATES = dict.fromkeys(("means", "quats", "scales", "opacities", "sh0", "shN"), 1e-3)
Timed = tuple[float, Message]  # seconds after the start of the task


@dataclass
class _Running:
    began: float
    messages: Iterator[Timed]
    due: float  # when the next message is sent
    message: Message


def grid(blocks: int) -> Grid:
    """A grid of that many blocks, as cubic as possible."""
    x = max(n for n in range(1, round(blocks ** (1 / 3)) + 1) if blocks % n == 0)
    rest = blocks // x
    y = max(n for n in range(1, int(rest**0.5) + 1) if rest % n == 0)
    return Grid((rest // y, y, x))


class SimulatedPool:
    """A pool of one-core workers for `Driver`; returns at most one message of each task at a time."""

    def __init__(self, workers: int, rate: float, seconds: float) -> None:
        """Args: rate, events per second of each block; seconds that a block takes on average."""
        self._nodes = tuple(Node(f"{i:03d}", f"worker-{i}", cpus=1, memory=2**40) for i in range(workers))
        self.sent: Counter[str] = Counter()  # events of progress, by task
        self.late = 0.0  # longest wait of a message of a block, seconds
        self.cpu = 0.0  # seconds used by the simulation itself
        self._rate, self._seconds = rate, seconds
        self._random = np.random.default_rng(0)
        self._running: dict[str, _Running] = {}

    def nodes(self) -> tuple[Node, ...]:
        """One node for each worker."""
        return self._nodes

    def put(self, value: object) -> Any:
        """The value itself: there is only one process."""
        return value

    def share_files(self, _scene: Iterable[Path], _run: Iterable[Path]) -> Locate:
        """Every file is read at its own path."""
        return here

    def start(self, name: str, _place: Place, _work: object, fields: dict[str, Any]) -> None:
        """Simulates a task."""
        now, messages = time.monotonic(), self._messages(name, fields)
        after, message = next(messages)
        self._running[name] = _Running(now, messages, now + after, message)

    def stop(self, name: str) -> None:
        """Not supported. Raises ValueError."""
        raise ValueError(f"{name} cannot be stopped")

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
        """The messages that are due, at the latest after `seconds`."""
        began = time.thread_time()
        first = min((task.due for task in self._running.values()), default=float("inf"))
        now = time.monotonic()
        if first > now:
            time.sleep(min(seconds, first - now))
            now = time.monotonic()
        due = [(name, task) for name, task in self._running.items() if task.due <= now]
        messages = [(name, self._take(name, task, now)) for name, task in due]
        self.cpu += time.thread_time() - began
        return messages

    def _take(self, name: str, task: _Running, now: float) -> Message:
        message = task.message
        self.sent[name] += isinstance(message, Progress)
        if name.startswith("block/"):
            self.late = max(self.late, now - task.due)
        if isinstance(message, Ended):
            del self._running[name]
        else:
            after, task.message = next(task.messages)
            task.due = task.began + after
        return message

    def _messages(self, name: str, fields: dict[str, Any]) -> Iterator[Timed]:
        yield 0.0, Hello("simulated", 0)
        after = 0.0
        for after, event in self._block(name, fields) if name.startswith("block/") else _other(name, fields):
            yield after, event
        yield after, Ended()

    def _block(self, name: str, fields: dict[str, Any]) -> Iterator[Timed]:
        """Progress by the clock, a checkpoint in the middle, the result with the last."""
        factor = self._random.uniform(1 - SPREAD, 1 + SPREAD)
        count = max(2, round(self._seconds * self._rate * factor))
        for i in range(1, count + 1):
            yield i / self._rate, Progress(name, i, count, self._rate, 0.1, 20.0, 10, 2**30, rates=_RATES)
            if i == count // 2:
                yield i / self._rate, Checkpoint(name, i, {"iteration": torch.tensor(i)})
        yield count / self._rate, Trained(name, _middles([fields["cell"]]), count, count / self._rate)


def _other(name: str, fields: dict[str, Any]) -> Iterator[Timed]:
    """The events of all tasks but the blocks, without delay."""
    if name == "coarse":
        yield 0.0, Trained(name, _coarse(fields), 1, 0.0)
    elif name == "eval":
        picture = np.zeros((fields["width"] // 2, fields["width"], 3), np.uint8)
        png = bytes(cv2.imencode(".png", picture)[1])
        for row in fields["views"]:
            yield 0.0, Evaluated(name, fields["scene"].panoramas[row].name, {"psnr": 20.0}, png)
    else:
        scores = torch.ones(len(fields["views"]), fields["blocks"], dtype=torch.float64)
        yield 0.0, Scored(name, fields["views"], scores)


def _coarse(fields: dict[str, Any]) -> Gaussians:
    """A Stage I model with a Gaussian in every block."""
    config, scene = fields["config"], fields["scene"]
    box = aabb(scene.centers[list(scene.train)], config.partition.rho_tri)
    return _middles([Cell(box, config.grid, block) for block in range(config.grid.count)])


def _middles(cells: Sequence[Cell]) -> Gaussians:
    """One Gaussian in the middle of each cell."""
    middles = [expand([np.mean(cell.grid.bounds(cell.block), axis=0)], cell.aabb) for cell in cells]
    return isotropic(np.concatenate(middles), np.ones(len(cells)), np.full((len(cells), 3), 0.5), 0.1)
