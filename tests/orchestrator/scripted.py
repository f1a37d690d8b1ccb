"""Specs of tasks without a scene, for the tests of pools."""

import os
import resource
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event as Flag
from threading import Thread

import torch

from panolog.orchestrator.engine.scheduling.pool import Ended, Failed, Message, Pool
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.scene.errors import DeviceError, InputError
from panolog.scene.image_files import decode
from panolog.scene.model import Scene
from panolog.workers import stopping
from panolog.workers.events import Checkpoint, Event, Notice, Preview
from panolog.workers.specs import Source, TaskSpec, Value
from panolog.workers.tasks import COARSE, TaskId

TASK = COARSE
NOTHING: Source[Scene] = Value(None)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False, kw_only=True)
class Scripted(TaskSpec):
    task: TaskId = TASK
    scene: Source[Scene] = NOTHING
    width: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Fails(Scripted):
    """Fails in one of several ways."""

    how: str

    def run(self) -> Iterator[Event]:
        yield Notice(TASK, self.how)
        errors = {
            "wrong": InputError("a.jpg is truncated"),
            "device": DeviceError("there is no GPU"),
            "bug": ValueError("no"),
            "host": MemoryError(),
            "gpu": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        }
        if self.how == "read":
            decode(Path("/nowhere/a.jpg"), 0)
        if self.how in errors:
            raise errors[self.how]
        torch.empty(2**60, dtype=torch.uint8)


class Works(Scripted):
    """Runs until it is requested to stop."""

    def run(self) -> Iterator[Event]:
        while not stopping.requested():
            yield Notice(TASK, os.environ.get("CUDA_VISIBLE_DEVICES", ""))
        yield Checkpoint(TASK, 7, {})


@dataclass(frozen=True, eq=False, kw_only=True)
class OnGpu(Scripted):
    """Says which GPU it has, and runs as `Works`; may fail then, as a task that has broken its context."""

    fails: str = ""

    def run(self) -> Iterator[Event]:
        yield Notice(self.task, os.environ.get("CUDA_VISIBLE_DEVICES", "none"))
        while not stopping.requested():
            yield Notice(self.task, "works")
        if self.fails == "illegal access":
            raise torch.AcceleratorError("CUDA error: an illegal memory access was encountered")
        if self.fails == "crash":
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            os.kill(os.getpid(), signal.SIGSEGV)
        yield Checkpoint(self.task, 7, {})


class Short(Scripted):
    """Sends one message."""

    def run(self) -> Iterator[Event]:
        yield Notice(TASK, "")


@dataclass(frozen=True, eq=False, kw_only=True)
class Holds(Scripted):
    """Holds so many bytes of memory."""

    size: int

    def run(self) -> Iterator[Event]:
        held = b"x" * self.size
        while held:
            yield Notice(TASK, "")


class SendsMuch(Scripted):
    """Sends a large message."""

    def run(self) -> Iterator[Event]:
        yield Preview(TASK, 1, "a.jpg", bytes(2**26))


class HangsAtExit(Scripted):
    """Sends its result, and its process does not end."""

    def run(self) -> Iterator[Event]:
        Thread(target=Flag().wait).start()  # not a daemon: the interpreter waits for it
        yield Notice(TASK, "")


def messages(pool: Pool, spec: TaskSpec, placement: Placement) -> Iterator[Message]:
    """The messages of a task."""
    pool.start(placement, spec)
    while True:
        for task in pool.ready(60):
            assert task == TASK
            message = pool.take(task)
            yield message
            if isinstance(message, Ended | Failed):
                return
