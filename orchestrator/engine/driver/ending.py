"""How an error ends a driver: with a record, except where no Python code runs any more, as by SIGKILL."""

import sqlite3
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.runs.records import Outcome, RunEnded
from panolog.scene.errors import ClusterError, ClusterLostError, PanologError, RunLockedError, first_line


@contextmanager
def end_recorded(journal: Journal) -> Iterator[None]:
    """Records what ends the context early, unless an end is recorded already, and raises it."""
    try:
        yield
    except BaseException as error:
        if journal.state.outcome is None:
            with suppress(OSError, sqlite3.Error, RunLockedError):  # any of these may be the reason
                journal.record([_end(error)])
        raise


def _end(error: BaseException) -> RunEnded:
    match error:
        case KeyboardInterrupt():
            return RunEnded(Outcome.INTERRUPTED)
        case PanologError():
            lost = isinstance(error, ClusterError | ClusterLostError)
            return RunEnded(Outcome.FAILED, str(error), transient=lost)
        case OSError() | sqlite3.Error():
            return RunEnded(Outcome.FAILED, str(error), transient=True)
    return RunEnded(
        Outcome.FAILED, internal(error), transient=True, detail="".join(traceback.format_exception(error))
    )


def internal(error: BaseException) -> str:
    """One line for an error that nothing foresees."""
    return f"internal error: {first_line(f'{type(error).__name__}: {error}')}"
