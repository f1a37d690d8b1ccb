"""Server-sent events: the whole truth first, then again whenever it has changed.

A client that reads slowly holds up nobody: it is woken, not queued for, and gets what is true when it can
take it. The kernel ends connections whose other side has stopped reading (see `server`).
"""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import suppress
from typing import Any

from panolog.orchestrator.dashboard.board import Board, Topic
from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.dashboard.watch import Watch
from panolog.orchestrator.records import Progressed, Stored

_PING = 10.0  # seconds between two signs of life
_PAUSE = 0.5  # seconds between two messages
_MOST = 200  # records in a message


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
        sent, last = -1, watch.history.last
        async for _ in _turns(topic):
            snapshot = watch.snapshot
            if snapshot.version == sent:
                yield b": ping\n\n"
                continue
            short = snapshot.changes(sent) if changes else None
            if snapshot.page is None:
                yield message("gone", encode({"error": snapshot.row["error"]}))
            elif short is not None:
                yield message("changes", await board.call(encode, short))
            else:
                yield message("run", snapshot.data)
            sent = snapshot.version
            news = [stored for stored in watch.news if stored.id > last]
            if news:
                last = news[-1].id
                yield message("events", await board.call(encode, {"events": thinned(news)}))


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


def thinned(news: Sequence[Stored]) -> list[dict[str, Any]]:
    """Records as the pages get them, newest first: of progress only the latest of each task."""
    latest = {stored.record.task: stored.id for stored in news if isinstance(stored.record, Progressed)}
    kept = [s for s in news if not isinstance(s.record, Progressed) or latest[s.record.task] == s.id]
    return [as_event(stored) for stored in kept[: -_MOST - 1 : -1]]


def as_event(stored: Stored) -> dict[str, Any]:
    """A record with its place in the history."""
    head = {"id": stored.id, "time": stored.time, "type": type(stored.record).__name__}
    return vars(stored.record) | head
