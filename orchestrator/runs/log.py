"""The log: standard `logging` on stderr, in one format for the driver and its workers.

Modules log their decisions with `logging.getLogger(__name__)`. Nothing is printed unless PANOLOG_LOG names a
level; `panolog -v` sets it to INFO, `-vv` to DEBUG. Workers inherit the variable.
"""

import logging
import os
import sys
from contextlib import suppress

from panolog.scene.errors import ConfigError

VARIABLE = "PANOLOG_LOG"
_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
_FORMAT = "%(asctime)s %(levelname)s %(process)d %(name)s: %(message)s"


class _Stderr(logging.Handler):
    """Writes to what `sys.stderr` is at the moment: the live display replaces it."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # its terminal was closed, or the disk under it is full
            print(self.format(record), file=sys.stderr, flush=True)


def configure(verbose: int = 0) -> None:
    """Starts the log of this process, and of processes that it starts.

    Args: verbose, 0 = as PANOLOG_LOG says, 1 = INFO, 2 and more = DEBUG.
    Raises ConfigError if PANOLOG_LOG names no level.
    """
    if verbose:
        os.environ[VARIABLE] = "INFO" if verbose == 1 else "DEBUG"
    level = os.environ.get(VARIABLE, "").upper()
    if not level:
        return
    if level not in _LEVELS:
        raise ConfigError(f"{VARIABLE}={os.environ[VARIABLE]}: choose one of {', '.join(_LEVELS)}")
    logger = logging.getLogger("panolog")
    logger.setLevel(level)
    if not any(isinstance(handler, _Stderr) for handler in logger.handlers):
        handler = _Stderr()
        handler.setFormatter(logging.Formatter(_FORMAT))
        logger.addHandler(handler)
        logger.propagate = False


def environment() -> dict[str, str]:
    """The variables that give a worker on another machine the same level."""
    return {VARIABLE: os.environ[VARIABLE]} if os.environ.get(VARIABLE) else {}
