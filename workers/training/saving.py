"""How a training task saves its checkpoints: how often, and into the run folder itself where it sees that.

A worker that shares the driver's disk writes the file under a name of its attempt; the driver checks it and
gives it the name of the checkpoint. So a worker whose attempt is over cannot replace the file of its
successor, and nothing large passes through the driver. Any other worker yields the checkpoint.
"""

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from panolog.scene.errors import RunError
from panolog.scene.files import SUFFIX
from panolog.workers.events import Checkpoint, CheckpointWritten, Event, Notice
from panolog.workers.training import checkpoint
from panolog.workers.training.config import CheckpointConfig

_LOG = logging.getLogger(__name__)
_MARKER = 1024  # bytes
_LONGEST_S = 1800.0  # between two checkpoints, however long saving takes


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

    def __init__(self, config: CheckpointConfig, outbox: Outbox | None) -> None:
        self._config = config
        self._outbox = outbox if outbox is not None and outbox.visible() else None
        self._last: Path | None = None  # the last file, until the driver has renamed it
        self._next = 0.0  # time.monotonic() from which on another checkpoint is worth its time

    def due(self, iteration: int) -> bool:
        """Whether to save after an iteration: not if that would take more than its share of the time."""
        return iteration % self._config.every == 0 and time.monotonic() >= self._next

    def save(self, state: Callable[[], Checkpoint], *, last: bool) -> Iterator[Event]:
        """Saves what `state` returns, and measures what that costs, with the wait for the driver.

        Args: last, save also where the driver has not yet taken the one before.
        """
        began = time.monotonic()
        if self._outbox is None:
            yield state()
        elif last or self._read():
            yield from self._write(state(), self._outbox)
        now = time.monotonic()
        self._next = now + min(_LONGEST_S, (now - began) * (1 / self._config.share - 1))

    def _read(self) -> bool:
        """Whether the driver has taken the last file, so that at most one is left at a time."""
        return self._last is None or not self._last.exists()

    def _write(self, state: Checkpoint, outbox: Outbox) -> Iterator[Event]:
        began, path = time.monotonic(), outbox.path(state.iteration)
        try:
            checkpoint.save(path, state)
            size = path.stat().st_size
        except (OSError, RunError) as error:
            _LOG.warning("%s: %s", state.task, error)
            yield Notice(state.task, f"cannot write into the run folder ({error}): the driver writes instead")
            yield state
            return
        self._last = path
        yield CheckpointWritten(state.task, state.iteration, path.name, size, time.monotonic() - began)
