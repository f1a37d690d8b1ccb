"""How long `panolog status` takes on a run, as a function call and as a command: for `driver_scale`.

    python -m benchmarks.status_times RUN

Asks until its stdin is closed, and at least once in each way, then prints the times as JSON.
"""

import io
import json
import select
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from statistics import median

from panolog.orchestrator.cli.run import status

CALLS = 20  # function calls for each command
_PAUSE = 0.1  # seconds between two questions: a person or a dashboard asks less often


def ask(root: Path) -> dict[str, dict[str, float]]:
    """Milliseconds by way of asking: how often, median and longest."""
    calls, commands = [], []
    while True:
        commands.append(_milliseconds(lambda: _command(root)))
        calls += [_milliseconds(lambda: _call(root)) for _ in range(CALLS) if not _closed(_PAUSE)]
        if _closed(0):
            break
    calls.append(_milliseconds(lambda: _call(root)))
    ways = {"function": calls, "command": commands}
    return {
        way: {"count": len(times), "median": median(times), "longest": max(times)}
        for way, times in ways.items()
    }


def _call(root: Path) -> None:
    with redirect_stdout(io.StringIO()):
        status(root, as_json=True)


def _command(root: Path) -> None:
    command = [str(Path(sys.executable).with_name("panolog")), "status", str(root), "--json"]
    subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=True)


def _milliseconds(work: Callable[[], None]) -> float:
    started = time.perf_counter()
    work()
    return (time.perf_counter() - started) * 1e3


def _closed(seconds: float) -> bool:
    """Whether stdin is at its end; waits at most so long for that."""
    readable, _, _ = select.select([sys.stdin], [], [], seconds)
    return bool(readable)


if __name__ == "__main__":
    print(json.dumps(ask(Path(sys.argv[1]))))
