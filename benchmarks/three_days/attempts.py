"""What one simulated attempt at a task sends, and the fault that ends it."""

import errno
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from benchmarks.driver_scale.simulated_pool import RATES as LEARNING_RATES
from benchmarks.three_days.faults import GIB, NOTICED, Fault, Host, Plan, first_fault
from benchmarks.three_days.load import Load
from panolog.orchestrator.resources.pool import Ended, Failed, Hello, Message
from panolog.orchestrator.resources.usage import Usage
from panolog.orchestrator.run.records import Failure
from panolog.scene.gaussians import Gaussians
from panolog.workers.events import Checkpoint, Notice, Preview, Progress, Trained
from panolog.workers.tasks import Stage
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.trainer import TrainSpec

START_S = 20.0  # from the start of a task to its first message
_FAILS_S = 5.0  # after that a broken machine fails it
_JPEG = bytes(cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1])
_CACHE = TrainConfig().cache.memory  # GiB
_MESSAGES: dict[Fault, Failed] = {
    Fault.KILLED: Failed("the worker process died: killed or crashed", Failure.LOST),
    Fault.EIO: Failed.of(OSError(errno.EIO, "Input/output error", "panorama.jpg"), "traceback"),
    Fault.MEMORY: Failed.of(MemoryError(), "traceback"),
    Fault.BAD_NODE: Failed.of(RuntimeError("CUDA error: unspecified launch failure"), "traceback"),
    Fault.NODE_LOST: Failed("the worker's machine died or cannot be reached", Failure.LOST),
}
Timed = tuple[float, Message]  # seconds since the start of the run


@dataclass(frozen=True)
class Place:
    """Where an attempt runs: one GPU of a host, as one of the nodes that this is in turn."""

    host: Host
    node: int  # of `Host.up`
    gpu: int


@dataclass(frozen=True)
class Attempt:
    """One at a task that trains."""

    spec: TrainSpec
    place: Place
    began: float  # seconds since the start of the run
    seconds: float  # of the whole task at this place
    first: int  # iteration of the checkpoint that it continues from
    load: Load

    def iteration(self, time: float) -> int:
        """What it has come to at a time."""
        done = (time - self.began - START_S) / self.seconds * self.load.iterations
        return min(self.load.iterations, self.first + max(0, int(done)))

    @property
    def end(self) -> float:
        """When it is done, if nothing happens to it."""
        left = 1 - self.first / self.load.iterations
        return self.began + START_S + left * self.seconds

    def work(self, result: Gaussians) -> Iterator[Timed]:
        """Notices, then progress, checkpoints and previews at their intervals, then the result."""
        load, task, rate = self.load, self.spec.task, self.load.iterations / self.seconds
        begun, each = self.began + START_S, max(1, load.iterations // load.previews)
        shown, step = self.first // each, 0
        for number in range(load.notices):
            yield begun, Notice(task, f"panorama-{number}.jpg: left out of the depth loss")
        while (at := begun + (step := step + 1) * load.progress) < self.end:
            now = self.iteration(at)
            yield at, Progress(task, now, load.iterations, rate, 0.1, 20.0, 10, 2**34, 2**33, LEARNING_RATES)
            if now // each > shown:
                shown = now // each
                yield at, Preview(task, now, "panorama.jpg", _JPEG)
            if step % round(load.checkpoint / load.progress) == 0:
                yield at, self.checkpoint(at)
            if self.place.gpu == 0 and step % round(load.usage / load.progress) == 0:
                yield at, Usage(self.place.host.name, 0.5, 2**35, 2**37, 2**38, 2**40)
        yield self.end, Trained(task, result, load.iterations, self.end - begun)

    def checkpoint(self, time: float) -> Checkpoint:
        """A small one of a time."""
        now = self.iteration(time)
        return Checkpoint(self.spec.task, now, {"iteration": torch.tensor(now)})


def messages(
    work: Iterator[Timed], fault: tuple[float, Fault], place: Place, began: float
) -> Iterator[Timed]:
    """All of an attempt, until a fault; what is hung or lost is silent until Ray misses its machine."""
    at, kind = fault
    hello = began + START_S
    if hello < at:
        yield hello, Hello(place.host.name, 1)
        for time, message in work:
            if time >= at:
                break
            yield time, message
        else:
            yield time, Ended()
            return
    if kind in (Fault.HUNG, Fault.NODE_LOST):
        yield place.host.up[place.node].end + NOTICED, _MESSAGES[Fault.NODE_LOST]
    else:
        yield at, _MESSAGES[kind]


def first_of(attempt: Attempt, plan: Plan, random: np.random.Generator) -> tuple[float, Fault]:
    """The first fault of an attempt, perhaps long after its end."""
    spec, host, began = attempt.spec, attempt.place.host, attempt.began
    after, kind = first_fault(attempt.load, random)
    faults = [(began + after, kind), node_fault(attempt.place, began)]
    if spec.task.stage is Stage.BLOCK:
        block, span = spec.task.number, attempt.end - began
        if block in plan.small_cache and spec.config.cache.memory >= _CACHE:
            faults.append((began + 0.3 * span, Fault.MEMORY))
        if block in plan.large_gpu and host.memory <= 24 * GIB:
            faults.append((began + 0.5 * span, Fault.MEMORY))
    return min(faults, key=lambda fault: fault[0])


def node_fault(place: Place, began: float) -> tuple[float, Fault]:
    """When the machine fails an attempt that begins now."""
    faults = [(place.host.up[place.node].end, Fault.NODE_LOST)]
    for period in place.host.bad:
        if began < period.end:
            faults.append((max(period.begin, began + START_S + _FAILS_S), Fault.BAD_NODE))
    return min(faults, key=lambda fault: fault[0])
