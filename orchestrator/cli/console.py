"""What the command line prints: results on stdout; messages and progress on stderr."""

import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, TextIO

from panolog.orchestrator.runs.folder import command_line

if TYPE_CHECKING:
    from rich.console import Console

_FIRST, _LINES = 3.0, 15.0  # seconds to the first line of progress and between two, without a terminal


class Lasting:
    """A text stream that drops what cannot be written.

    Its reader may have ended (`panolog run … 2>&1 | tee`, Ctrl-C), its terminal may be closed, the disk under
    it may be full: a run continues, and saves its checkpoints when it is stopped for the same reason.
    """

    def __init__(self, stream: TextIO) -> None:
        """Args: stream, which messages go to as long as it takes them."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes text, or drops it where writing fails; returns its length."""
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flushes what was written, or drops it where that fails."""
        with suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@cache
def err() -> "Console":
    """The console on stderr; Rich is imported when there is something to print."""
    from rich.console import Console

    return Console(stderr=True)


def say(line: str, *, style: str | None = None) -> None:
    """Prints one line on stderr."""
    err().print(line, style=style, highlight=False, markup=False, soft_wrap=True)


def command(*words: object) -> str:
    """`panolog` with these words, in backquotes, as a shell on Linux takes it."""
    return f"`{command_line(*words)}`"


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
def progress_bar(step: str, *, resumable: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """Progress on stderr while the context lasts: a bar on a terminal, otherwise lines.

    The lines come after 3 seconds, every 15 seconds and at the end of a step, so quick work prints none.
    Yields the function to call with (step, done, total); a total of 0 is unknown.

    Args: step, what is done until the first call; resumable, on Ctrl-C say that finished work is kept.
    """
    with (_bar if err().is_terminal else _lines)(step) as show:
        try:
            yield show
        except KeyboardInterrupt:
            if resumable:
                say("finished work is kept; the same command resumes it")
            raise


@contextmanager
def _bar(step: str) -> Iterator[Callable[[str, int, int], None]]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from panolog.orchestrator.runs.units import duration

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[count]}"))
    with Progress(*columns, TimeElapsedColumn(), console=err(), transient=True) as bars:
        bar, current = bars.add_task(step, total=None, count=""), step

        def show(step: str, done: int, total: int) -> None:
            nonlocal current
            if step != current:
                bars.reset(bar, description=step)
                current = step
            bars.update(bar, completed=done, total=total or None)
            left = bars.tasks[0].time_remaining
            count = f"{done:,} of {total:,}" + (f", {duration(left)} left" if left else "") if total else ""
            bars.update(bar, count=count)

        yield show


@contextmanager
def _lines(step: str) -> Iterator[Callable[[str, int, int], None]]:
    began, latest, ended = time.monotonic(), (step, 0, 0), Event()

    def line() -> str:
        step, done, total = latest
        return f"{step}: {done:,} of {total:,}" if total else f"{step}: {time.monotonic() - began:.0f} s"

    def show(step: str, done: int, total: int) -> None:
        nonlocal began, latest
        if step != latest[0]:
            began = time.monotonic()
        finished = done == total and latest != (step, done, total)
        latest = step, done, total
        if finished and time.monotonic() - began > _FIRST:
            say(line())

    def report() -> None:
        wait = _FIRST
        while not ended.wait(wait):
            wait = _LINES
            if not latest[2] or latest[1] < latest[2]:
                say(line())

    reporter = Thread(target=report, daemon=True)
    reporter.start()
    try:
        yield show
    finally:
        ended.set()
        reporter.join()


def say_results(root: Path, state: Any) -> None:
    """Says what a run has made and where."""
    from panolog.orchestrator.runs.folder import RunFolder
    from panolog.orchestrator.watch.views.comparison.measured import read_measured
    from panolog.orchestrator.watch.views.terminal import metrics_line
    from panolog.scene.errors import InputError
    from panolog.workers.tasks import NOTHING_HELD_OUT

    folder = RunFolder(root)
    if state.money.reached is not None:
        longer = command("resume", root, "--max-cost", "none", "--deadline", "none")
        say(f"ended early: {state.money.reached.reason}; {longer}, or with higher limits, completes it")
    if state.merged is None:
        say("there is no model: the limit has ended the run before its first checkpoint")
        return
    say(f"model     {folder.point_cloud} ({state.merged.gaussians:,} Gaussians)")
    metrics = f"{folder.metrics} ({metrics_line(state.metrics or {}) or NOTHING_HELD_OUT})"
    try:
        if read_measured(folder) is None:
            metrics = f"are missing; {command('eval', root)} measures them again"
    except InputError as error:
        metrics = str(error)
    say(f"metrics   {metrics}")
    if folder.images.is_dir():
        say(f"pictures  {folder.images}")
    if folder.web.is_dir():
        say(f"web page  {folder.web} (for any web server)")
    if folder.plan_picture.exists():
        say(f"partition {folder.plan_picture}")
    say("now open")
    if folder.report.exists():
        say(f"  the report       {folder.report.absolute().as_uri()}")
    say(f"  the model in 3D  {command('view', root)}")
    say(f"  the dashboard    {command('dashboard', root)}")
