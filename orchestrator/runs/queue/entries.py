"""What a queue holds: runs that wait, run or have ended, each with its command."""

from dataclasses import dataclass
from pathlib import Path

from panolog.workers.tasks import StrEnum


class State(StrEnum):
    """How an entry stands. REMOVED entries stay in the database, so that no number is used twice."""

    WAITING = "waiting"
    RUNNING = "running"  # until its end is known: also while no runner is at work
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"  # by a user; `retry` resumes it
    REMOVED = "removed"


@dataclass(frozen=True)
class Identity:
    """A process, so that another one that gets its number later is not taken for it."""

    boot: str  # of the machine: /proc/sys/kernel/random/boot_id
    pid: int
    started: int  # clock ticks after the boot at which it began: /proc/PID/stat


@dataclass(frozen=True)
class Needs:
    """What a run is to get of the machine; None: as `shares.Machine.wanted` chooses."""

    gpus: int | None = None
    cores: int | None = None
    memory: int | None = None  # bytes of main memory


@dataclass(frozen=True)
class Share:
    """What a run has of the machine while it works; None: all, undivided."""

    gpus: tuple[str, ...] | None = None  # as CUDA_VISIBLE_DEVICES calls them
    cores: tuple[int, ...] | None = None
    memory: int | None = None  # bytes of main memory


@dataclass(frozen=True)
class Command:
    """What `queue add` was given."""

    run: Path  # the run folder, absolute
    first: tuple[str, ...]  # words that follow `panolog run`
    later: tuple[str, ...]  # words that follow `panolog resume RUN`
    folder: Path  # in which both are executed
    needs: Needs | None = Needs()  # None: nothing of this machine, the run is on a cluster


@dataclass(frozen=True)
class Entry:
    """One run of a queue; times in seconds since the epoch."""

    id: int
    position: int  # smaller ones come first
    state: State
    command: Command
    added: float
    began: float | None = None  # its latest start
    ended: float | None = None
    process: Identity | None = None  # the supervisor that was started last
    starts: int = 0
    losses: int = 0  # supervisors in a row that were soon killed, while the runner lived
    code: int | None = None  # exit code of its end
    reason: str = ""  # why it has failed or was stopped, or what it waits for; one line
    share: Share | None = None  # what it has while it works; None: nothing, or it has not begun

    @property
    def open(self) -> bool:
        """Whether it waits or runs."""
        return self.state in (State.WAITING, State.RUNNING)

    @property
    def interrupted(self) -> bool:
        """Whether it has run before and is to be resumed."""
        return self.starts > 0
