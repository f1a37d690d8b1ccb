"""A follower from the begin of a run's command to the delivery of the last news."""

import os
import threading
import time
from functools import partial
from hashlib import sha256
from pathlib import Path

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.follower.board import Board
from panolog.orchestrator.watch.follower.couriers import Courier
from panolog.orchestrator.watch.follower.loggers import Logger
from panolog.orchestrator.watch.follower.recipients import LAST_S, Recipients, SinkChoice
from panolog.orchestrator.watch.follower.sinks.interface import Sink
from panolog.orchestrator.watch.follower.watcher import Watcher

POLL_S = 1.0  # between two looks at the database
_ORPHAN_S = 60.0  # that a driver without its supervisor gets to write its last checkpoints


class Follower:
    """Follows one run. Args: parent, the process whose end is the end of the run's command."""

    def __init__(self, root: Path, parent: int, recipients: Recipients) -> None:
        self._folder, self._parent = RunFolder(root), parent
        self._watcher = Watcher(self._folder, recipients.stalled)
        self._board = Board()
        kept = self._folder.follower
        couriers = [Courier(it, self._board, kept / _name(it.kind, it.label)) for it in recipients.targets]
        loggers = [
            Logger(it.kind, partial(_made, it, root), self._board, root, kept / _name(it.kind, it.place))
            for it in recipients.sinks
        ]
        self._threads: list[Courier | Logger] = [*couriers, *loggers]

    def follow(self, ended: threading.Event) -> list[str]:
        """Works until the run's command has ended and the last news are delivered, or LAST_S later.

        Args: ended, set when the command has ended. Returns what could not be done, a line each.
        """
        threading.excepthook = _note_error
        for thread in self._threads:
            thread.start()
        while not (ended.wait(POLL_S) or self._orphaned):
            live = self._folder.database.is_file()
            if live and (self._watcher.look() or self._watcher.stall()):
                self._board.publish(self._watcher.news())
        self._wait_for_driver()
        if self._folder.database.is_file():
            self._watcher.look()
        left = not lock.held(self._folder.lock)
        self._board.publish(self._watcher.news(ended=True, left=left), LAST_S)
        for thread in self._threads:
            thread.join(max(0.1, self._board.left + 1.0))
        return [f"{thread.label}: {thread.problem}" for thread in self._threads if thread.problem]

    @property
    def _orphaned(self) -> bool:
        return os.getppid() != self._parent

    def _wait_for_driver(self) -> None:
        """A supervisor may be gone before its driver; any other holder of the lock is not ours."""
        end = time.monotonic() + _ORPHAN_S
        while self._orphaned and lock.held(self._folder.lock) and time.monotonic() < end:
            time.sleep(POLL_S)


def _note_error(error: threading.ExceptHookArgs) -> None:
    """An unforeseen error ends one thread. Its text may quote a secret, so its type alone is kept."""
    if isinstance(error.thread, Courier | Logger):
        error.thread.problem = f"internal error: {error.exc_type.__name__}"


def _name(kind: str, which: str) -> str:
    """The name of a ledger. Args: which, of that kind: without a secret."""
    return f"{kind}-{sha256(which.encode()).hexdigest()[:12]}.json"


def _made(choice: SinkChoice, root: Path) -> Sink:
    """The sink itself; its package is imported now."""
    if choice.kind == "tensorboard":
        from panolog.orchestrator.watch.follower.sinks.tensorboard_sink import TensorBoardSink  # noqa: PLC0415

        return TensorBoardSink(Path(choice.place) if choice.place else root / "tensorboard")
    if choice.kind == "mlflow":
        from panolog.orchestrator.watch.follower.sinks.mlflow_sink import MlflowSink  # noqa: PLC0415

        return MlflowSink(choice.place)
    from panolog.orchestrator.watch.follower.sinks.wandb_sink import WandbSink  # noqa: PLC0415

    return WandbSink(choice.place or "panolog", RunFolder(root).follower)
