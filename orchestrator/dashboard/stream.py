"""Server-sent events: the whole truth first, then again whenever it has changed.

A client that reads slowly holds up nobody: it is woken, not queued for, and gets what is true when it can
take it. The kernel ends connections whose other side has stopped reading (see `server`).
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

from panolog.orchestrator.dashboard.board import Board, Topic
from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.dashboard.snapshot import Snapshot
from panolog.orchestrator.dashboard.watch import Watch

_PING = 10.0  # seconds between two signs of life
_PAUSE = 0.5  # seconds between two messages


def message(event: str, data: bytes) -> bytes:
    """One server-sent event; JSON in one line needs no more."""
    return b"event: " + event.encode() + b"\ndata: " + data + b"\n\n"


async def runs(board: Board) -> AsyncIterator[bytes]:
    """The list of runs, whenever it has changed."""
    topic, sent = board.list, -1
    with topic.followed():
        await topic.look()
        async for _ in _turns(topic):
            if board.version != sent:
                sent = board.version
                yield message("runs", board.data)
            else:
                yield b": ping\n\n"


async def run(board: Board, watch: Watch, topic: Topic, *, changes: bool) -> AsyncIterator[bytes]:
    """One run, whenever it has changed, and its new records."""
    with topic.followed():
        await topic.look()
        sent, last = -1, watch.snapshot.last
        async for _ in _turns(topic):
            snapshot = watch.snapshot
            if snapshot.version == sent:
                yield b": ping\n\n"
                continue
            short, news = await board.call(_what_is_new, snapshot, sent if changes else None, last)
            if snapshot.page is None:
                yield message("gone", encode({"error": snapshot.row["error"]}))
            elif short is not None:
                yield message("changes", short)
            else:
                yield message("run", snapshot.data)
            sent = snapshot.version
            if news is not None:
                yield message("events", news)
            last = max(last, snapshot.last)


async def _turns(topic: Topic) -> AsyncIterator[None]:
    """When to say something: at once, then at every change but not too often, and now and then anyway."""
    while not topic.closed:
        changed = topic.changed
        yield
        if not topic.closed:
            await asyncio.sleep(_PAUSE)
            await wait(changed, _PING)


async def wait(changed: asyncio.Event, seconds: float) -> None:
    """Waits for a change, but not for ever."""
    with suppress(asyncio.TimeoutError):
        await asyncio.wait_for(changed.wait(), seconds)


def _what_is_new(snapshot: Snapshot, sent: int | None, last: int) -> tuple[bytes | None, bytes | None]:
    """The changes since a version, unless that is None, and the records after one."""
    return None if sent is None else snapshot.changes(sent), snapshot.told(last)
