"""What a page can ask of a run: its driver through the control channel, or a new driver."""

import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

from panolog.orchestrator.dashboard.places import Place, read_below
from panolog.orchestrator.run import control, lock, policy
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.views.timeline import History
from panolog.scene.errors import InputError

RESUME = "resume"
_LOG = "resume.log"
_PROGRAM = "from panolog.orchestrator.cli.app import main; main()"
_TAIL = 20_000_000  # bytes of it at most: enough for the longest driver's lines


@dataclass
class Resumed:
    """A driver that this server has started; it outlives the server."""

    process: subprocess.Popen[bytes]

    @property
    def starting(self) -> bool:
        """Whether it is still there. Also clears up after it, once it is not."""
        return self.process.poll() is None


def offers(place: Place, history: History, resumed: Resumed | None, *, running: bool) -> dict[str, Any]:
    """What can be asked now, if nothing why not, and how a driver has failed that was started from here."""
    if running:
        why, available, failed = control.allowed(place.folder), list(control.ACTIONS), None
    else:
        why, available = _no_resume(place, history, resumed), [RESUME]
        failed = (
            _last_line(place) if resumed and not resumed.starting and resumed.process.returncode else None
        )
    return {
        "allowed": why is None,
        "why": why,
        "available": [] if why else available,
        "failed": failed,
    }


def act(place: Place, history: History, action: str, block: int | None) -> Resumed | None:
    """Does what a page asks. Raises InputError if it makes no sense now, OSError if it cannot be written."""
    folder = place.folder
    if action != RESUME:
        request = control.request(action, block)
        why = control.allowed(folder) or policy.refusal(history.state, request)
        if why is not None:
            raise InputError(f"{request}: {why}")
        control.ask(folder, action, block)
        return None
    if block is not None:
        raise InputError("resume is of the whole run, not of a block")
    if lock.held(folder.lock):
        raise InputError("resume: a driver is at work on the run")
    if (why := _no_resume(place, history, None)) is not None:
        raise InputError(f"resume: {why}")
    return _resume(place)


def _no_resume(place: Place, history: History, resumed: Resumed | None) -> str | None:
    """Why the run cannot be gone on with from here; None if it can."""
    state, root = history.state, place.folder.root
    if state.outcome == "done":
        return "the run is done"
    if resumed and resumed.starting:
        return "it is about to go on"
    if not os.access(root, os.W_OK | os.X_OK):
        return f"you may not write to {place.name}"
    if history.host not in (None, socket.gethostname()):
        return f"it was driven from {history.host}: `panolog resume` there goes on"
    if any(start.node != history.host for start in history.starts.values()):
        return "it ran on a cluster: `panolog resume --address` goes on"
    return None


def _resume(place: Place) -> Resumed:
    """Starts `panolog resume` as a process of its own. Raises InputError if it could not even begin."""
    info, root = read_info(place.folder), place.folder.root
    if not os.path.isdir(info.scene.path):  # noqa: PTH112  # whatever the string is
        raise InputError(f"resume: the scene {info.scene.path} is not there")
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
    log = os.open(root / _LOG, flags, 0o644)
    try:
        command = [sys.executable, "-c", _PROGRAM, "resume", str(root)]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
    finally:
        os.close(log)
    return Resumed(process)


def _last_line(place: Place) -> str:
    """What a driver said last."""
    try:
        text = read_below(place.folder.root / _LOG, place.folder.root, _TAIL).decode(errors="replace")
    except InputError:
        return f"see {_LOG}"
    lines = text.split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), f"see {_LOG}")
