"""What the driver hears of a task: that it has begun, its events, how it has ended."""

from dataclasses import dataclass

from panolog.workers.events import Event

# Why an attempt failed. What follows from each is `policy.after_failure`'s to say.
ERROR = "error"  # the task itself: trying again may help
INPUT = "input"  # what the user gave: trying again is pointless
MEMORY = "memory"  # there was not enough of it
LOST = "lost"  # its process or its machine is gone: the task need not be to blame


@dataclass(frozen=True)
class Hello:
    """The first message of a task: where it runs."""

    node: str
    pid: int


@dataclass(frozen=True)
class Ended:
    """The last message of a task that ran to its end."""


@dataclass(frozen=True)
class Failed:
    """The last message of a task that did not."""

    reason: str  # one line
    kind: str = ERROR
    detail: str = ""  # the traceback of what nobody has foreseen


Message = Hello | Event | Ended | Failed
