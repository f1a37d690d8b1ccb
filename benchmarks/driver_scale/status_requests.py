"""How long `status` of a live run takes, measured in another process.

A module of its own: a fresh process imports the module of its function, which cannot be a `__main__`.
"""

import io
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median

from benchmarks.runs import BIN
from panolog.orchestrator.cli.run import status
from panolog.scene.errors import RunError

CALLS = 20  # function calls for each command
_TIMEOUT_S = 60.0  # for the last results
_PAUSE_S = 0.1  # between two requests; a person or a dashboard makes fewer
Times = dict[str, dict[str, float]]  # milliseconds by kind of request: count, median, longest


@contextmanager
def status_requests(root: Path) -> Iterator[Times]:
    """Requests the run's status from another process all the time; fills the dictionary at the end."""
    context, times = get_context("spawn"), Times()
    ours, theirs = context.Pipe()
    process = context.Process(target=request_status, args=(root, theirs))
    process.start()
    theirs.close()
    try:
        yield times
        ours.send(None)
        if not ours.poll(_TIMEOUT_S):
            raise RunError(f"{root}: `status` did not end")
        times.update(ours.recv())
    except (EOFError, BrokenPipeError):
        raise RunError(f"{root}: `status` failed during the run") from None
    finally:
        process.terminate()
        process.join()


def request_status(root: Path, stop: Connection) -> None:
    """Requests the status, at least once in each way, until a message comes; then sends the Times."""
    calls, commands = [], []
    while True:
        commands.append(_milliseconds(lambda: _command(root)))
        calls += [_milliseconds(lambda: _call(root)) for _ in range(CALLS) if not stop.poll(_PAUSE_S)]
        if stop.poll():
            break
    calls.append(_milliseconds(lambda: _call(root)))
    kinds = {"function": calls, "command": commands}
    stop.send(
        {
            kind: {"count": len(times), "median": median(times), "longest": max(times)}
            for kind, times in kinds.items()
        }
    )


def _call(root: Path) -> None:
    with redirect_stdout(io.StringIO()):
        status(root, as_json=True)


def _command(root: Path) -> None:
    subprocess.run([BIN / "panolog", "status", str(root), "--json"], stdout=subprocess.DEVNULL, check=True)


def _milliseconds(work: Callable[[], None]) -> float:
    started = time.perf_counter()
    work()
    return (time.perf_counter() - started) * 1e3
