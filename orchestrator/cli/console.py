"""What the command line prints: results on stdout; messages and progress on stderr."""

import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

_LINES = 15.0  # seconds between two lines of progress where stderr is not a terminal


@cache
def err() -> "Console":
    """The console on stderr; Rich is imported when there is something to print."""
    from rich.console import Console

    return Console(stderr=True)


def say(line: str, *, style: str | None = None) -> None:
    """Prints one line on stderr."""
    err().print(line, style=style, highlight=False, markup=False, soft_wrap=True)


def print_json(content: dict[str, Any]) -> None:
    """Prints the one JSON object of a command on stdout."""
    print(json.dumps(content, indent=2, allow_nan=False))


def print_result(content: dict[str, Any], lines: Iterable[str], *, as_json: bool) -> None:
    """Prints a result on stdout: as JSON, or as lines for people."""
    if as_json:
        print_json(content)
        return
    for line in lines:
        print(line)


@contextmanager
def progress_bar(*, quiet: bool = False, resumable: bool = True) -> Iterator[Callable[[str, int, int], None]]:
    """Progress on stderr: a bar on a terminal, else a line every 15 seconds and at the end of each step.

    Yields the function to call with (step, done, total).

    Args:
        quiet: print nothing where stderr is not a terminal.
        resumable: on Ctrl-C, say that the finished work is kept.
    """
    from rich.progress import Progress

    live = err().is_terminal
    with Progress(console=err(), transient=True, disable=not live) as bars:
        bar, current, printed = bars.add_task("", total=None), "", 0.0

        def show(step: str, done: int, total: int) -> None:
            nonlocal current, printed
            if step != current:
                bars.reset(bar, description=step)
                current, printed = step, time.monotonic()
            bars.update(bar, completed=done, total=total)
            if not (live or quiet) and (time.monotonic() - printed > _LINES or done == total):
                printed = time.monotonic()
                say(f"{step}: {done} of {total}")

        try:
            yield show
        except KeyboardInterrupt:
            if resumable:
                say("finished work is kept; the same command resumes it")
            raise
