"""How a training task saves its checkpoints: how often, and into the run folder itself where it sees that.

A worker that shares the driver's disk writes the file under a name of its attempt; the driver checks it and
gives it the name of the checkpoint. So a worker whose attempt is over cannot replace the file of its
successor, and nothing large passes through the driver. Any other worker yields the checkpoint.

On a GPU a checkpoint leaves it through pinned memory, is written by a thread while training continues, and is
due after some time at the earliest.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor

from panolog.scene.errors import RunError
from panolog.scene.files import SUFFIX
from panolog.scene.tensors.transfer import packed_bytes, unpack
from panolog.workers.events import Checkpoint, CheckpointWritten, Event, Notice
from panolog.workers.training import checkpoint
from panolog.workers.training.task_config import CheckpointConfig

_LOG = logging.getLogger(__name__)
_MARKER = 1024  # bytes
_LONGEST_S = 1800.0  # between two checkpoints, however long saving takes

Tensors: TypeAlias = Mapping[str, Tensor]
State: TypeAlias = Callable[[Callable[[Tensors], dict[str, Tensor]]], Checkpoint]  # makes one of such copies


def copied(tensors: Tensors) -> dict[str, Tensor]:
    """Copies on the CPU."""
    return {name: tensor.to("cpu", copy=True) for name, tensor in tensors.items()}


class Staging:
    """Copies of tensors on a GPU, in one buffer of pinned memory that is used again.

    Its size is a power of two, as torch makes it anyway: at most twice that of the checkpoint, which is what
    the estimate has for it.
    """

    def __init__(self) -> None:
        self._buffer = torch.empty(0, dtype=torch.uint8)

    def copied(self, tensors: Tensors) -> dict[str, Tensor]:
        """Copies that are valid until the next call. All of them run at once, the host waits for the last."""
        size = packed_bytes(tensors)
        if len(self._buffer) < size:
            self._buffer = torch.empty(0, dtype=torch.uint8)
            if hasattr(torch.accelerator, "empty_host_cache"):  # or torch keeps what was too small
                torch.accelerator.empty_host_cache()
            self._buffer = torch.empty(1 << (size - 1).bit_length(), dtype=torch.uint8, pin_memory=True)
        copies = unpack(self._buffer, tensors)
        for name, copy in copies.items():
            copy.copy_(tensors[name], non_blocking=True)
        torch.cuda.current_stream().synchronize()
        return copies


@dataclass(frozen=True)
class Outbox:
    """Where an attempt leaves its checkpoints."""

    folder: Path  # of the task, in the run folder
    attempt: str  # names of files begin with it
    marker: Path  # a file of the live driver in the run folder
    token: str  # in that file: who reads it sees the driver's folder

    def visible(self) -> bool:
        """Whether the driver's folder is here, under the same path."""
        try:
            with self.marker.open("rb") as file:
                return self.token.encode() in file.read(_MARKER)
        except OSError:
            return False

    def path(self, iteration: int) -> Path:
        """The file of one checkpoint. It has the name of a partial file: the driver removes what is left."""
        return self.folder / f".{self.attempt}-{iteration}{SUFFIX}"


class Saver:
    """Saves the checkpoints of one attempt."""

    def __init__(self, config: CheckpointConfig, outbox: Outbox | None, device: str = "cpu") -> None:
        self._config = config
        self._outbox = outbox if outbox is not None and outbox.visible() else None
        self._last: Path | None = None  # the last file, until the driver has renamed it
        self._cuda = device != "cpu"
        self._copied = Staging().copied if self._cuda else copied  # for files, written before the next
        self._writer = ThreadPoolExecutor(1, "checkpoint")  # on a GPU, which trains meanwhile
        self._writing: Future[list[Event]] | None = None
        self._interval = config.interval if self._cuda else 0.0
        # time.monotonic() from which on another checkpoint is worth its time
        self._next = time.monotonic() + self._interval if self._cuda else 0.0

    def due(self, iteration: int) -> bool:
        """Whether to save after an iteration: not if that would take more than its share of the time."""
        idle = self._writing is None and time.monotonic() >= self._next
        return idle and iteration % self._config.every == 0

    def finished(self, *, wait: bool = False) -> Iterator[Event]:
        """The events of the file that a thread was writing, once it is done. Args: wait, for that."""
        if self._writing is not None and (wait or self._writing.done()):
            events, self._writing = self._writing.result(), None
            yield from events

    def save(self, state: State, *, last: bool) -> Iterator[Event]:
        """Saves what `state` returns, and measures what that costs, with the wait for the driver.

        On a GPU a file is written while training continues, and `finished` has its event. A task that ends
        with this checkpoint waits for it.

        Args: last, the task ends: save also where the driver has not yet taken the one before.
        """
        began = time.monotonic()
        yield from self.finished(wait=True)  # its memory is used again
        if self._outbox is None:
            yield state(copied)
        elif last or self._read():
            self._writing = self._writer.submit(self._write, state(self._copied), self._outbox)
            yield from self.finished(wait=last or not self._cuda)
        now = time.monotonic()
        pause = min(_LONGEST_S, (now - began) * (1 / self._config.share - 1))
        self._next = max(now + pause, began + self._interval)

    def _read(self) -> bool:
        """Whether the driver has taken the last file, so that at most one is left at a time."""
        return self._last is None or not self._last.exists()

    def _write(self, state: Checkpoint, outbox: Outbox) -> list[Event]:
        began, path = time.monotonic(), outbox.path(state.iteration)
        try:
            checkpoint.save(path, state)
            size = path.stat().st_size
        except (OSError, RunError) as error:
            _LOG.warning("%s: %s", state.task, error)
            why = f"cannot write into the run folder ({error}): the driver writes instead"
            own = replace(state, tensors=copied(state.tensors))  # the next checkpoint may take their memory
            return [Notice(state.task, why), own]
        self._last = path
        return [CheckpointWritten(state.task, state.iteration, path.name, size, time.monotonic() - began)]
