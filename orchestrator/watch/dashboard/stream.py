"""Server-sent events: a complete message first, then again whenever it has changed.

A client that reads slowly delays no other: it is woken, nothing is queued for it, and it gets the state of
the moment when it can read. The kernel ends connections whose client has stopped reading (see `server`).
"""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress

from panolog.orchestrator.watch.dashboard.registry import RunRegistry, Topic
from panolog.orchestrator.watch.dashboard.watch import Snapshot, Watch
from panolog.orchestrator.watch.views.pages.encoding import encode

_PING_S = 10.0  # between two messages at most
_PAUSE_S = 0.5  # between two messages at least


def message(event: str, data: bytes) -> bytes:
    """One server-sent event; JSON in one line needs no more."""
    return b"event: " + event.encode() + b"\ndata: " + data + b"\n\n"


async def runs(registry: RunRegistry) -> AsyncIterator[bytes]:
    """The list of runs, whenever it has changed."""
    topic, sent = registry.list, -1
    with topic.subscribed():
        await topic.refresh()
        async for _ in _turns(topic):
            if registry.version != sent:
                sent = registry.version
                yield message("runs", registry.data)
            else:
                yield b": ping\n\n"


async def run(
    registry: RunRegistry, watch: Watch, topic: Topic, begin: Callable[[], Awaitable[None]], *, changes: bool
) -> AsyncIterator[bytes]:
    """One run, whenever it has changed, and its new records.

    Args: begin, called when its first task trains: what shows its model will be wanted soon.
    """
    with topic.subscribed():
        await topic.refresh()
        sent, last = -1, watch.snapshot.last
        async for _ in _turns(topic):
            if topic.closed:
                await topic.refresh()  # the server ends, perhaps because the run has: its last state
            snapshot = watch.snapshot
            if snapshot.version == sent:
                yield b": ping\n\n"
                continue
            changes_since, events = await registry.call(_news, snapshot, sent if changes else None, last)
            if snapshot.page is None:
                yield message("gone", encode({"error": snapshot.row.error}))
            elif changes_since is not None:
                yield message("changes", changes_since)
            else:
                yield message("run", snapshot.data)
            sent, page = snapshot.version, snapshot.page
            if page is not None and watch.running and page.summary.tasks and not page.result.in_3d:
                await begin()
            if events is not None:
                yield message("events", events)
            last = max(last, snapshot.last)


async def _turns(topic: Topic) -> AsyncIterator[None]:
    """One item for each message: now, then at each change but not too often, at least every _PING_S, and
    one after the topic was closed.
    """
    closed = False
    while not closed:
        closed, changed = topic.closed, topic.changed
        yield
        if not closed:
            await asyncio.sleep(_PAUSE_S)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(changed.wait(), _PING_S)


def _news(snapshot: Snapshot, sent: int | None, last: int) -> tuple[bytes | None, bytes | None]:
    """The changes since a version, unless that is None, and the records after one."""
    return None if sent is None else snapshot.changes(sent), snapshot.events(last)
