"""The control channel of a run: what people ask its driver to do, as small files in RUN/control.

Whoever may write the run folder may ask; the driver looks whenever it has heard of its workers, takes the
files away and does what makes sense (`policy.answer`). Nothing is listened to but the file system, so it
works wherever the run folder can be seen.
"""

import json
import os
import secrets
import stat
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RUN, Noticed
from panolog.orchestrator.run.state import block_task
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes

STOP, PAUSE, UNPAUSE, RETRY = "stop", "pause", "unpause", "retry"
ACTIONS = (STOP, PAUSE, UNPAUSE, RETRY)
_OF_BLOCKS = (PAUSE, UNPAUSE, RETRY)
_MOST = 100  # requests taken at a time
_SIZE = 256  # bytes of a request at most
_NAME = "control"  # the task that notices about requests are of


@dataclass(frozen=True)
class Request:
    """What somebody wants: the run to stop, or something of one block."""

    action: str  # one of ACTIONS
    block: int | None = None  # None for STOP

    @property
    def task(self) -> str:
        """The name of the task that it is about."""
        return RUN if self.block is None else block_task(self.block)

    def __str__(self) -> str:
        return self.action if self.block is None else f"{self.action} block {self.block}"


def request(action: Any, block: Any = None) -> Request:
    """A request that says something. Raises InputError if it does not."""
    if action not in ACTIONS:
        raise InputError(f"{action!r} is none of {', '.join(ACTIONS)}")
    if action in _OF_BLOCKS and (type(block) is not int or block < 0):
        raise InputError(f"{action} needs the number of a block, not {block!r}")
    if action not in _OF_BLOCKS and block is not None:
        raise InputError(f"{action} is of the whole run, not of a block")
    return Request(action, block)


def allowed(folder: RunFolder) -> str | None:
    """Why nothing can be asked of a run now; None if it can."""
    if not lock.held(folder.lock):
        return "no driver is at work on the run"
    if not folder.control.is_dir():
        return "its driver does not listen yet"
    if not os.access(folder.control, os.W_OK | os.X_OK):
        return f"you may not write to {folder.control}"
    return None


def ask(folder: RunFolder, action: str, block: int | None = None) -> None:
    """Leaves a request for the driver.

    Raises InputError if it says nothing or if nothing can be asked of the run; OSError if it cannot be
    written.
    """
    wanted = request(action, block)
    if (why := allowed(folder)) is not None:
        raise InputError(f"{folder.root}: {why}")
    name = f"{time.time_ns():020d}-{secrets.token_hex(4)}.json"  # names are in the order of asking
    write_bytes(folder.control / name, json.dumps(vars(wanted)).encode())


def take(folder: RunFolder) -> list[Request | Noticed]:
    """What has been asked since the last look, in order, and a notice in place of each nonsense.

    The files are gone when it returns. Raises OSError if they cannot be read or removed.
    """
    try:
        with os.scandir(folder.control) as entries:
            waiting = (e for e in entries if e.name.endswith(".json") and not e.is_dir(follow_symlinks=False))
            names = sorted(entry.name for entry in islice(waiting, _MOST))
    except FileNotFoundError:
        return []
    return [_take_one(folder, name) for name in names]


def begin(folder: RunFolder) -> list[Noticed]:
    """Begins to listen: makes the folder, so that it is the driver's, and takes away what is there already.

    Raises OSError if that is impossible.
    """
    folder.control.mkdir(exist_ok=True)
    notices = []
    while asked := take(folder):
        for said in asked:
            late = notice(f"{said}: was asked of an earlier driver, so nothing is done")
            notices.append(said if isinstance(said, Noticed) else late)
    return notices


def notice(text: str) -> Noticed:
    """What the channel has to say to the user."""
    return Noticed(_NAME, text)


def _take_one(folder: RunFolder, name: str) -> Request | Noticed:
    path = folder.control / name
    try:
        taken: Request | Noticed = _parse(_content(path))
    except (InputError, ValueError) as error:
        taken = notice(f"control/{name!a} is no request: {error}")
    path.unlink(missing_ok=True)
    return taken


def _parse(content: bytes) -> Request:
    """Raises ValueError or InputError if that is no request."""
    fields = json.loads(content)
    if not isinstance(fields, dict) or not fields.keys() <= {"action", "block"}:
        raise ValueError("it is not of the form {action, block}")
    return request(fields.get("action"), fields.get("block"))


def _content(path: Path) -> bytes:
    """The bytes of a file that may be anything. Raises ValueError if it is not a small plain file."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise ValueError(error.strerror) from error
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise ValueError("it is not a plain file")
        content = os.read(handle, _SIZE + 1)
    finally:
        os.close(handle)
    if len(content) > _SIZE:
        raise ValueError(f"it has more than {_SIZE} bytes")
    return content
