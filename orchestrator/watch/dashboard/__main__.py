"""`run --dashboard`: the dashboard of one run as a process of its own next to the driver.

A program of its own, because the run must continue whatever happens to it. It ends when its standard input
does, which is when the driver has ended, however that came.

    python -m panolog.orchestrator.watch.dashboard RUN     # prints its URL on stdout
"""

import gc
import os
import signal
import sys
from pathlib import Path
from threading import Thread

from panolog.orchestrator.watch.dashboard import guard
from panolog.orchestrator.watch.dashboard.discovery import RunEntry

_HOST = "127.0.0.1"


def _end_with_input() -> None:
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


def main(run: Path) -> None:
    """Serves until standard input ends. Who opens the URL at once waits for the rest of the imports."""
    listener = guard.listen(_HOST, 0)
    url = guard.address(listener, _HOST, None)
    print(f"{url}runs/{RunEntry(run, '.').id}", flush=True)
    Thread(target=_end_with_input, daemon=True).start()
    gc.disable()  # for a seventh of the time: of what is imported nothing is garbage
    from panolog.orchestrator.watch.dashboard import server  # noqa: PLC0415

    gc.enable()
    server.serve(run, listener, None)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
