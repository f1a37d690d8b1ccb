"""What the driver hears of a task: that it has begun, its events, how it has ended."""

from dataclasses import dataclass

from panolog.orchestrator.run.records import ERROR
from panolog.workers.events import Event


@dataclass(frozen=True)
class Hello:
    """The first message of a task: where it runs."""

    node: str
    pid: int
    oom_kills: int = 0  # `machine.oom_kills` at that moment


@dataclass(frozen=True)
class Ended:
    """The last message of a task that ran to its end."""


@dataclass(frozen=True)
class Failed:
    """The last message of a task that did not."""

    reason: str  # one line
    kind: str = ERROR  # ERROR, INPUT, MEMORY or LOST of `records`
    detail: str = ""  # the traceback of what nobody has foreseen


Message = Hello | Event | Ended | Failed
