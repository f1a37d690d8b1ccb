"""How long `status` of a live run takes, measured in another process.

A module of its own: a fresh process imports the module of its function, which cannot be a `__main__`.
"""

import io
import subprocess
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from statistics import median

from benchmarks.runs import BIN
from panolog.orchestrator.cli.run import status
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.scene.errors import RunError

CALLS = 20  # function calls for each command
_PAUSE_S = 0.1  # between two requests; a person or a dashboard makes fewer
Times = dict[str, dict[str, float]]  # milliseconds by kind of request: count, median, longest


def request_status(root: Path) -> Times:
    """Requests a run's status as long as it has a driver, at least once in each way.

    Raises RunError if the command fails, InputError as the function does.
    """
    path = RunFolder(root).lock
    calls, commands = [_milliseconds(lambda: _call(root))], [_milliseconds(lambda: _command(root))]
    while lock.held(path):
        if len(calls) > CALLS * len(commands):
            commands.append(_milliseconds(lambda: _command(root)))
        time.sleep(_PAUSE_S)
        calls.append(_milliseconds(lambda: _call(root)))
    kinds = {"function": calls, "command": commands}
    return {
        kind: {"count": len(times), "median": median(times), "longest": max(times)}
        for kind, times in kinds.items()
    }


def _call(root: Path) -> None:
    with redirect_stdout(io.StringIO()):
        status(str(root), as_json=True)


def _command(root: Path) -> None:
    command = [str(BIN / "panolog"), "status", str(root), "--json"]
    if code := subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise RunError(f"panolog status {root} ended with {code}")


def _milliseconds(work: Callable[[], None]) -> float:
    started = time.perf_counter()
    work()
    return (time.perf_counter() - started) * 1e3
