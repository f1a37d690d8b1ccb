"""Large messages of workers: how many bytes they carry, and what announces them to a driver."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from panolog.workers.events import Checkpoint, Evaluated, Preview, Scored, Trained

T = TypeVar("T")


@dataclass(frozen=True)
class Large:
    """The next message of the task but others of this kind is a checkpoint or a model."""

    size: int  # bytes


def payload(message: object) -> int:
    """Bytes of what is large in a message."""
    match message:
        case Checkpoint():
            return sum(tensor.nbytes for tensor in message.tensors.values())
        case Trained():
            return sum(tensor.nbytes for tensor in message.gaussians.tensors().values())
        case Scored():
            return message.scores.nbytes
        case Preview():
            return len(message.jpeg) + (0 if message.snapshot is None else payload(message.snapshot))
        case Evaluated():
            return len(message.png)
    return 0


def announced(messages: Iterable[T], ahead: int = 1) -> Iterator[T | Large]:
    """The messages of a task, with a `Large` before each checkpoint and model.

    Args: ahead, messages that may be unread before the next one is made. The `Large` is repeated until so
    many have followed the last large message: that one is read then, and no task has two in memory.
    """
    since = ahead
    for message in messages:
        if isinstance(message, Checkpoint | Trained):
            for _ in range(max(1, ahead - since)):
                yield Large(payload(message))
            since = 0
        else:
            since += 1
        yield message
