"""RUN/store/state.json: how far a run in an object store has been copied out, for all that show it."""

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from panolog.orchestrator.runs.folder import read_object
from panolog.orchestrator.runs.units import duration, gib
from panolog.scene.files import write_bytes

_MOST = 64 * 1024  # bytes of the file
_LATE_S = 120.0  # behind the run from which on that is worth a warning
_SILENT_S = 120.0  # after which a mirror that has said nothing counts as ended


@dataclass(frozen=True)
class MirrorState:
    """What a mirror says of itself. Times in seconds since the epoch."""

    url: str  # of the run
    published: str = ""  # the manifest that its pointer names
    announced: str = ""  # one that its pointer may name already
    since: float = 0.0  # all that the run had made by then is in the store; 0: nothing is yet
    pending_files: int = 0
    pending_bytes: int = 0
    problem: str = ""  # why it cannot proceed at present
    complete: bool = False  # the driver has ended and all is out
    time: float = 0.0  # of this state

    @property
    def line(self) -> str:
        if self.complete:
            return f"all of the run is in {self.url}"
        left = f"{self.pending_files:,} files ({gib(self.pending_bytes)}) to go" if self.pending_files else ""
        behind = (
            f"{self.url} is {duration(self.lag)} behind" if self.since else f"nothing is in {self.url} yet"
        )
        return "; ".join(filter(None, (behind, left, self.problem)))

    @property
    def brief(self) -> str:
        """The line; nothing that changes all the time while all is well."""
        return self.line if self.late or self.complete else f"copied to {self.url}"

    @property
    def lag(self) -> float:
        """Seconds of the run that would be lost with this machine."""
        return 0.0 if self.complete else max(0.0, time.time() - self.since)

    @property
    def late(self) -> bool:
        """Whether people should know."""
        return bool(self.problem) or (not self.complete and self.lag > _LATE_S)


_FILE = TypeAdapter(MirrorState)


def write_state(path: Path, state: MirrorState) -> None:
    """Leaves the state. A full disk changes nothing: the driver reports that."""
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, _FILE.dump_json(replace(state, time=time.time())))


def read_state(path: Path, *, running: bool = False) -> MirrorState | None:
    """The state; None if the run is in no store, or the file is damaged.

    Args: running, whether a driver is at work: then a mirror that is silent is a problem.
    """
    try:
        state = _FILE.validate_python(read_object(path, _MOST))
    except ValidationError:  # the URL is missing, or a value is of another type
        return None
    if running and not state.complete and time.time() - state.time > _SILENT_S:
        return replace(state, problem="the mirror has ended; resume the run")
    return state
