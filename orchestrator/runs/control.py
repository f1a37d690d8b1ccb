"""The control channel of a run: requests of the user to its driver, as small files in RUN/control.

Any process that may write the run folder may send one. The driver polls the folder, removes the files and
carries out what is possible (`answer`).
"""

import json
import os
import re
import secrets
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from typing_extensions import assert_never

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.database import read_milestones
from panolog.orchestrator.runs.folder import RunFolder, read_below
from panolog.orchestrator.runs.machines.history import NodeState
from panolog.orchestrator.runs.records import (
    NodeReleased,
    Noticed,
    Part,
    PauseRequested,
    Record,
    RetryRequested,
    UnpauseRequested,
)
from panolog.orchestrator.runs.state import RunState, Status, TaskState, replay
from panolog.scene.errors import InputError, RunFolderError
from panolog.scene.files import FULL, write_bytes
from panolog.workers.tasks import StrEnum, TaskId

_LIMIT = 100  # requests taken at a time
_NAMED = 5  # machines named in a line at most
_MAX_BYTES = 512  # of a request
_NODE = re.compile(r"[\w.:-]{1,255}", re.ASCII)  # a host name or an id


class Action(StrEnum):
    """What a user may request."""

    STOP = "stop"
    PAUSE = "pause"
    UNPAUSE = "unpause"
    RETRY = "retry"
    RELEASE = "release"


_RECORDS: dict[Action, type[PauseRequested | UnpauseRequested | RetryRequested]] = {
    Action.PAUSE: PauseRequested,
    Action.UNPAUSE: UnpauseRequested,
    Action.RETRY: RetryRequested,
}


@dataclass(frozen=True)
class ControlRequest:
    """A user's request: to stop the run, about one block, or about a machine in quarantine."""

    action: Action
    block: int | None = None  # to pause, unpause and retry
    node: str | None = None  # to release: its host, or how its id begins

    def __str__(self) -> str:
        if self.node is not None:
            return f"{self.action} {self.node}"
        return str(self.action) if self.block is None else f"{self.action} block {self.block}"


def request(action: Any, block: Any = None, node: Any = None) -> ControlRequest:
    """A valid request. Raises InputError if the values make none."""
    if action not in list(Action):
        raise InputError(f"{action!r} is none of {', '.join(Action)}")
    if action == Action.STOP:
        if block is not None:
            raise InputError(f"{action} is of the whole run, not of a block")
    elif action == Action.RELEASE:
        if block is not None or not isinstance(node, str) or not _NODE.fullmatch(node):
            raise InputError(
                f"{action} needs the host of a machine or the begin of its id, not {node!a:.150}"
            )
    elif type(block) is not int or block < 0:
        raise InputError(f"{action} needs the number of a block, not {block!r}")
    if node is not None and action != Action.RELEASE:
        raise InputError(f"{action} is not of a machine")
    return ControlRequest(Action(action), block, node)


def at_work(folder: RunFolder) -> bool:
    """Whether a driver, or the supervisor that starts the next one, is at work on the run."""
    return lock.held(folder.lock) or lock.held(folder.supervisor)


def allowed(folder: RunFolder) -> str | None:
    """Why the run takes no requests now; None if it does."""
    if not at_work(folder):
        return "no driver is at work on the run"
    if not folder.control.is_dir():
        return "its driver takes no requests yet"
    if not os.access(folder.control, os.W_OK | os.X_OK):
        return f"you may not write to {folder.control}"
    return None


def send(folder: RunFolder, action: str, block: int | None = None, node: str | None = None) -> None:
    """Leaves a request for the driver.

    Raises InputError if it is invalid, the run takes none or its disk is full; OSError if it cannot be
    written.
    """
    wanted = request(action, block, node)
    if (why := allowed(folder)) is not None:
        raise RunFolderError(f"{folder.root}: {why}")
    name = f"{time.time_ns():020d}-{secrets.token_hex(4)}.json"  # names are in the order of requests
    try:
        write_bytes(folder.control / name, json.dumps(vars(wanted)).encode())
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise RunFolderError(
            f"{folder.root}: its disk is full, so no request reaches the driver; free some space, or stop "
            "the run with Ctrl-C in its terminal or `kill -INT` and the number of its process"
        ) from error


def take(folder: RunFolder) -> list[ControlRequest | Noticed]:
    """The requests since the last call, in order, with a notice in place of each invalid one.

    The files are gone when it returns. Raises OSError if they cannot be read or removed.
    """
    try:
        with os.scandir(folder.control) as entries:
            waiting = (e for e in entries if e.name.endswith(".json") and not e.is_dir(follow_symlinks=False))
            names = sorted(entry.name for entry in islice(waiting, _LIMIT))
    except FileNotFoundError:
        return []
    return [_take_one(folder, name) for name in names]


def stop_requested(folder: RunFolder) -> bool:
    """Whether a stop is among the requests that no driver has taken. Takes none.

    Raises OSError if they cannot be read.
    """
    for path in folder.control.glob("*.json"):
        with suppress(InputError, ValueError):
            if _parse(read_below(path, folder.control, _MAX_BYTES)).action == Action.STOP:
                return True
    return False


def begin(folder: RunFolder) -> list[Noticed]:
    """Opens the channel: makes the folder and discards requests that an earlier driver did not take.

    Raises OSError if that is impossible.
    """
    folder.control.mkdir(exist_ok=True)
    notices = []
    while requests := take(folder):
        late = "was requested of an earlier driver, so nothing is done"
        notices += [it if isinstance(it, Noticed) else _notice(f"{it}: {late}") for it in requests]
    return notices


def refusal(state: RunState, request: ControlRequest) -> str | None:
    """Why a request is impossible in a state of the run; None if it is possible."""
    if request.action == Action.STOP:
        return None
    if request.action == Action.RELEASE:
        return _no_release(state, request.node or "")
    trained = [block.block for block in state.plan or () if block.train]
    if state.plan is None:
        return "there are no blocks yet"
    if request.block not in trained:
        return f"there is no block {request.block} to train"
    task = state.task(TaskId.block(request.block))
    match request.action:
        case Action.PAUSE:
            over = task.status in (Status.DONE, Status.FAILED)
            return "it is paused" if task.held else f"it is {task.status}" if over else None
        case Action.UNPAUSE:
            return None if task.held else "it is not paused"
        case Action.RETRY:
            return _no_retry(state, task)
        case _:
            assert_never(request.action)


def _no_release(state: RunState, node: str) -> str | None:
    found = _in_quarantine(state, node)
    if not found:
        names = ", ".join(known.host for known in state.quarantined()[:_NAMED])
        return f"no such machine is in quarantine; {f'those are {names}' if names else 'none is'}"
    hosts = sorted({known.host for known in found})
    return None if len(hosts) == 1 else f"that is more than one machine: {', '.join(hosts[:_NAMED])}"


def _in_quarantine(state: RunState, node: str) -> list[NodeState]:
    quarantined = state.quarantined()
    by_host = [known for known in quarantined if known.host == node]
    return by_host or [known for known in quarantined if known.id.startswith(node)]


def _no_retry(state: RunState, task: TaskState) -> str | None:
    failed = task.status == Status.FAILED or task.errors or task.losses or task.shortages
    if task.status == Status.DONE or not failed:
        return "it has not failed"
    if state.joined(task.id):
        return "the blocks are merged: resume the run after its end, which tries the block again"
    return None


def answer(state: RunState, request: ControlRequest) -> Sequence[Record]:
    """The records of a request about a block or a machine, or a notice if it is impossible now."""
    if (why := refusal(state, request)) is not None:
        return [_notice(f"{request}: {why}")]
    if request.action == Action.RELEASE:
        found = _in_quarantine(state, request.node or "")
        return [NodeReleased(node.id, node.host, "a user has released it") for node in found]
    return [_RECORDS[request.action](TaskId.block(request.block or 0))]


def _notice(text: str) -> Noticed:
    return Noticed(Part.CONTROL, text)


def _take_one(folder: RunFolder, name: str) -> ControlRequest | Noticed:
    path = folder.control / name
    try:
        taken: ControlRequest | Noticed = _parse(read_below(path, folder.control, _MAX_BYTES))
    except (InputError, ValueError) as error:
        taken = _notice(f"control/{name!a} is not a request: {error}")
    path.unlink(missing_ok=True)
    return taken


def _parse(content: bytes) -> ControlRequest:
    """Raises ValueError or InputError if the content is no request."""
    fields = json.loads(content)
    if not isinstance(fields, dict) or not fields.keys() <= {"action", "block", "node"}:
        raise ValueError("it is not of the form {action, block, node}")
    return request(fields.get("action"), fields.get("block"), fields.get("node"))


def state_of(root: Path) -> RunState:
    """The state of the run in a folder; an empty one if there is no run, or its records cannot be read."""
    database = RunFolder(root).database
    with suppress(OSError, RunFolderError):
        return replay(read_milestones(database)) if database.exists() else RunState()
    return RunState()
