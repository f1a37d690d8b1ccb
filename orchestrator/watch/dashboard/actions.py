"""What a page can do with a run: send requests to its driver, or start a new driver."""

import os
import socket
import subprocess
import sys

from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.folder import command_line
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.runs.preparation.settings import read_settings
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.dashboard.messages import Actions
from panolog.orchestrator.watch.views.history import History
from panolog.scene.errors import InputError, last_line
from panolog.scene.stores.url import is_url

RESUME = "resume"
_LOG = "resume.log"
_PROGRAM = "from panolog.orchestrator.cli.app import main; main()"
_TAIL = 20_000_000  # bytes of it at most: enough for the longest driver's lines
Driver = subprocess.Popen[bytes]  # one that this server has started; it continues when the server ends


def available_actions(entry: RunEntry, history: History, resumed: Driver | None, *, running: bool) -> Actions:
    """What can be done now, if nothing why not, and the last line of a driver that failed."""
    if running:
        why, available, failed = control.allowed(entry.folder), list(map(str, control.Action)), None
    else:
        why, available = _no_resume(entry, history, resumed), [RESUME]
        failed = _last_line(entry) if resumed and resumed.poll() else None
    return Actions(allowed=why is None, why=why, available=() if why else tuple(available), failed=failed)


def perform(
    entry: RunEntry, history: History, action: str, block: int | None, node: str | None
) -> Driver | None:
    """Does what a page requests. Raises InputError if that is not possible now, OSError if writing fails."""
    folder = entry.folder
    if action != RESUME:
        request = control.request(action, block, node)
        why = control.allowed(folder) or control.refusal(history.state, request)
        if why is not None:
            raise InputError(f"{request}: {why}")
        control.send(folder, action, block, node)
        return None
    if block is not None or node is not None:
        raise InputError("only a whole run can be resumed, not a block or a machine")
    if lock.held(folder.lock):
        raise InputError("resume: a driver is at work on the run")
    if (why := _no_resume(entry, history, None)) is not None:
        raise InputError(f"resume: {why}")
    return _resume(entry)


def _no_resume(entry: RunEntry, history: History, resumed: Driver | None) -> str | None:
    """Why the run cannot be resumed from here; None if it can."""
    state, root = history.state, entry.folder.root
    host, command = state.driver.host if state.driver else None, command_line("resume", root)
    if state.outcome == "done":
        return "the run is done"
    if state.outcome == "limited":
        return f"a limit has ended it: use `{command}` with a higher --max-cost or a later --deadline"
    if resumed and resumed.poll() is None:
        return "it is being resumed"
    if not os.access(root, os.W_OK | os.X_OK):
        return f"you may not write to {entry.name}"
    if host not in (None, socket.gethostname()):
        return f"it was driven from {host}: use `{command}` there"
    if any(start.node != host for start in history.starts.values()):
        return f"it ran on a cluster: use `{command} --address HOST:PORT`"
    return None


def _resume(entry: RunEntry) -> Driver:
    """Starts `panolog resume` as a process of its own. Raises InputError if the scene is gone."""
    info, root = read_info(entry.folder), entry.folder.root
    # whatever the string is; the run may also have still to make it
    if not (is_url(info.scene.path) or os.path.isdir(info.scene.path)) and not _makes_its_scene(entry):  # noqa: PTH112
        raise InputError(f"resume: the scene {info.scene.path} does not exist")
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
    log = os.open(root / _LOG, flags, 0o644)
    try:
        command = [sys.executable, "-c", _PROGRAM, "resume", str(root)]
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
        )
    finally:
        os.close(log)


def _makes_its_scene(entry: RunEntry) -> bool:
    """Whether the run was given panoramas or a video."""
    try:
        return read_settings(entry.folder) is not None
    except InputError:
        return False


def _last_line(entry: RunEntry) -> str:
    """The last line of a driver's output."""
    try:
        text = entry.folder.read(entry.folder.root / _LOG, _TAIL).decode(errors="replace")
    except InputError:
        return f"see {_LOG}"
    return last_line(text) or f"see {_LOG}"
