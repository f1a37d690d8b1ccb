"""All runs below the folder: one watch for each, refreshed in threads, shared by all clients."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from panolog.orchestrator.watch.dashboard.discovery import discover
from panolog.orchestrator.watch.dashboard.queues.panel import QueuePanel
from panolog.orchestrator.watch.dashboard.watch import Watch
from panolog.orchestrator.watch.views.pages.encoding import encode

_THREADS = 16
_RUN_S = 0.25  # between two refreshes of a run whose page is open
_LIST_S = 0.5  # the same of the list, while it is open
_IDLE_S = 0.005  # until a run without a driver is refreshed again, for each run of the list
_SEARCH_S = 0.25  # between two searches for runs at least
_SEARCH_SHARE = 20.0  # of the time that a search took until the next one
_BUDGET_S = 0.7  # of one refresh of the list: of runs that are not read by then only the name is shown
_Answer = TypeVar("_Answer")


class Topic:
    """Something that clients follow: it is refreshed while there are any, and wakes them when it changes."""

    def __init__(self, read: Callable[[], int], pause: float, pool: ThreadPoolExecutor) -> None:
        """`read` reads it once, in a thread, and returns its version."""
        self._read = read
        self._pause = pause
        self._pool = pool
        self._version = 0
        self.changed = asyncio.Event()  # set at the next change, and then replaced
        self._refreshing: asyncio.Task[None] | None = None
        self._following: asyncio.Task[None] | None = None
        self.clients = 0
        self.closed = False

    def start_refresh(self) -> "asyncio.Task[None]":
        """Starts a refresh, or returns the one that has not ended yet."""
        if self._refreshing is None or self._refreshing.done():
            self._refreshing = asyncio.create_task(self._refresh_once())
        return self._refreshing

    async def refresh(self) -> None:
        """Refreshes it once."""
        await asyncio.shield(self.start_refresh())

    @contextmanager
    def subscribed(self) -> Iterator[None]:
        """Counts a client, and keeps refreshing, while the context lasts."""
        self.clients += 1
        if self._following is None or self._following.done():
            self._following = asyncio.create_task(self._follow())
        try:
            yield
        finally:
            self.clients -= 1

    def close(self) -> None:
        """Wakes all clients for the last time."""
        self.closed = True
        self._wake()

    async def _follow(self) -> None:
        while self.clients and not self.closed:
            await self.refresh()
            await asyncio.sleep(self._pause)

    async def _refresh_once(self) -> None:
        version = await asyncio.get_running_loop().run_in_executor(self._pool, self._read)
        if version != self._version:
            self._version = version
            self._wake()

    def _wake(self) -> None:
        self.changed.set()
        self.changed = asyncio.Event()


class RunRegistry:
    """The runs below a folder."""

    def __init__(self, root: Path, queue: Path | None = None) -> None:
        """Args: queue, folder of the queue that the list shows, if any."""
        self.root = root.resolve()
        self.queue = QueuePanel(queue, self.root)
        self._pool = ThreadPoolExecutor(_THREADS, "dashboard")
        self._watches: dict[str, Watch] = {}
        self._topics: dict[str, tuple[Watch, Topic]] = {}
        self._search_lock = threading.Lock()
        self._next_search = 0.0  # time.monotonic()
        self._due: dict[str, float] = {}  # when each run of the list is refreshed again
        self.version = 0
        self.data = b"{}"
        self.list = Topic(self._refresh_list, _LIST_S, self._pool)

    async def run(self, id: str) -> tuple[Watch, Topic] | None:
        """A run and its clients; None if there is none of that id."""
        if id not in self._watches and time.monotonic() >= self._next_search:
            await self.call(self._search)
        watch = self._watches.get(id)
        if watch is None:
            return None
        known = self._topics.get(id)
        if known is None or known[0] is not watch:  # a run that was gone for a time has another watch
            known = self._topics[id] = (watch, Topic(watch.refresh, _RUN_S, self._pool))
        return known

    async def call(self, work: Callable[..., _Answer], *arguments: Any) -> _Answer:
        """Does work that reads files, in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, work, *arguments)

    def start(self, work: Callable[..., object], *arguments: Any) -> None:
        """Does in a thread what will soon be requested; an error is shown to who requests it."""
        self._pool.submit(work, *arguments)

    def end(self) -> None:
        """Ends the threads when they have done what they are at; `call` is not possible any more."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Wakes all clients for the last time."""
        for topic in (self.list, *(topic for _, topic in self._topics.values())):
            topic.close()

    def _search(self) -> None:
        """Adds runs that are new and drops those that are gone and have no clients."""
        with self._search_lock:
            begun = time.monotonic()
            found = discover(self.root)
            took = time.monotonic() - begun
            self._next_search = begun + took + max(_SEARCH_S, _SEARCH_SHARE * took)
            old = self._watches
            kept = {id: watch for id, watch in old.items() if id in found or self._has_clients(id)}
            self._watches = kept | {id: Watch(entry) for id, entry in found.items() if id not in old}

    def _has_clients(self, id: str) -> bool:
        known = self._topics.get(id)
        return known is not None and known[1].clients > 0

    def _refresh_list(self) -> int:
        """Refreshes rows of the list within its time. Returns the version of the list."""
        start = time.monotonic()
        if start >= self._next_search:
            self._search()
        watches = self._watches
        for id in sorted(watches, key=lambda id: self._due.get(id, 0.0)):
            now = time.monotonic()
            if self._due.get(id, 0.0) > start or now - start > _BUDGET_S:
                break
            watches[id].refresh_row()
            self._due[id] = now if watches[id].running else now + _IDLE_S * len(watches)
        rows = [watch.snapshot.row for watch in watches.values()]
        data = encode(
            {
                "folder": str(self.root),
                "runs": sorted(rows, key=lambda row: (-(row.created or 0.0), row.name)),
                "queue": self.queue.read(),
            }
        )
        if data != self.data:
            self.data, self.version = data, self.version + 1
        return self.version
