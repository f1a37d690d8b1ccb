"""RUN/follower/NAME.json: what of a run a target or a sink has, so that the next follower continues there.

A ledger of another run, as of one whose folder was used before, counts as none.
"""

import json
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs.folder import read_object
from panolog.scene.files import write_bytes

_MOST = 16 * 2**20  # bytes of a file


class Ledger:
    """One file. Values are for JSON."""

    def __init__(self, path: Path, run: str) -> None:
        """Reads the file; one that is damaged counts as none. Args: run, `notifications.run_id`."""
        self._path = path
        self._run = run
        content = read_object(path, _MOST)
        self._values = content if content.get("run") == run else {}

    @property
    def new(self) -> bool:
        """Whether nothing was kept yet."""
        return not self._values

    def get(self, name: str, default: Any) -> Any:
        """A value; the default if it is missing or of another type."""
        value = self._values.get(name, default)
        return value if isinstance(value, type(default)) else default

    def keep(self, **values: Any) -> None:
        """Sets values; they are on the disk when it returns.

        Raises OSError if that is impossible; the next call then writes them too.
        """
        self._values = {**self._values, **values, "run": self._run}
        content = (json.dumps(self._values, allow_nan=False) + "\n").encode()
        self._path.parent.mkdir(exist_ok=True)
        try:
            write_bytes(self._path, content)
        except FileNotFoundError:  # a driver that begins has removed the temporary file
            write_bytes(self._path, content)
