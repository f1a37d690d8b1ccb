"""`--at-end`: a command that is carried out when a run has ended for good, such as one that ends the machine.

It is for what only the first process of a command line can know: that no driver follows, and that the
store and those who are notified have everything.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL, Popen, TimeoutExpired

from panolog.orchestrator.runs import control
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.runs.storage.state import read_state
from panolog.scene.errors import InputError, in_one_line

_LONGEST_S = 600.0  # for the command; then it continues by itself
_REFUSED, _INTERRUPTED = 2, 130  # exit codes of panolog
Say = Callable[[str], None]


@contextmanager
def when_ended(wanted: str | None, say: Say) -> Iterator[Callable[[Path], None]]:
    """Carries out a command of the shell when the context has ended a run for good, however.

    Not if the user has stopped it, another driver is at work on the run, or its store lacks some of it.

    Args: wanted, the command; None for none; say, called with lines. Yields what to call with the folder of
    the run once it is this process's.
    """
    roots: list[Path] = []
    code, why = 0, ""
    try:
        yield roots.append
    except KeyboardInterrupt:
        code = _INTERRUPTED
        raise
    except BaseException as error:
        code = getattr(error, "exit_code", _REFUSED if isinstance(error, InputError) else 1)
        why = "" if hasattr(error, "exit_code") else in_one_line(error)
        raise
    finally:
        if wanted and roots and code != _INTERRUPTED:
            _end(wanted, RunFolder(roots[-1]), code, why, say)


def _end(wanted: str, folder: RunFolder, code: int, why: str, say: Say) -> None:
    """Carries the command out, unless something would be lost by it."""
    if control.at_work(folder):
        say("--at-end is not carried out: another driver is at work on the run")
        return
    mirror = read_state(folder.mirror)
    if mirror is not None and not mirror.complete:
        say(f"--at-end is not carried out, for nothing to be lost: {mirror.line}")
        return
    outcome, reason = _outcome(folder.root, code)
    run = str(folder.root.absolute())
    said = {"PANOLOG_OUTCOME": outcome, "PANOLOG_REASON": why or reason, "PANOLOG_RUN": run}
    say(f"carrying out --at-end: {wanted}")
    try:
        process = Popen(
            ["/bin/sh", "-c", wanted],
            env=os.environ | said,
            stdin=DEVNULL,
            start_new_session=True,  # it outlives this process and its terminal
        )
        failed = process.wait(_LONGEST_S)
    except OSError as error:
        say(f"--at-end cannot be carried out: {error.strerror}")
    except TimeoutExpired:
        say(f"--at-end has not ended after {_LONGEST_S:.0f} s; it continues by itself")
    else:
        if failed:
            say(f"--at-end has failed (code {failed}): what it was to end may still be there, and paid")


def _outcome(root: Path, code: int) -> tuple[str, str]:
    """How the run has ended, and why: done, limited, failed or refused. Args: code, panolog's exit code."""
    state = control.state_of(root)
    if code == 0:
        reached = state.money.reached
        return str(state.outcome or Outcome.DONE), reached.reason if reached else state.reason
    refused = code == _REFUSED and state.outcome != Outcome.FAILED
    return "refused" if refused else str(Outcome.FAILED), state.reason or f"exit code {code}"
