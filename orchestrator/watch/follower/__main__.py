"""The process of a follower: gets its recipients in the first line of stdin, and ends after the line END.

The end of stdin is no sign: a process that is killed closes its pipes before its lock of the run, one by one,
and gives its children another parent when all are closed. So that it delivers the last news, a follower
ignores the signals that end a run. Separate: it is a program.
"""

import os
import signal
import sys
import threading
from contextlib import suppress

from panolog.orchestrator.watch.follower.follower import Follower
from panolog.orchestrator.watch.follower.recipients import END, from_json


def main() -> None:
    """Runs the process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    line = sys.stdin.readline()
    if not line.endswith("\n"):  # its parent has ended before
        return
    root, parent, recipients = from_json(line)
    ended = threading.Event()

    def wait() -> None:
        if sys.stdin.readline() == END + "\n":
            ended.set()

    threading.Thread(target=wait, daemon=True).start()
    problems = Follower(root, parent, recipients).follow(ended)
    with suppress(OSError):  # the parent is gone
        for problem in problems:
            print(problem, flush=True)
    os._exit(0)  # without waiting for a target that hangs


if __name__ == "__main__":
    main()
