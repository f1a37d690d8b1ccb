"""All runs that somebody looks at: one watch for each, looked through in threads, shared by all clients."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.dashboard.places import discover
from panolog.orchestrator.dashboard.watch import Watch

_THREADS = 16
_LOOK = 0.25  # seconds between two looks at a run whose page is open
_LIST = 0.5  # the same at the list, while it is open
_REST = 0.005  # seconds for each run until one without a driver is looked at again
_SEEK = (
    1.0,
    20.0,
)  # seconds between two searches for runs: so many at least, and so many times what one took
_BUDGET = 0.7  # seconds of one look at the list: of what is not read by then only the name is known
_Answer = TypeVar("_Answer")


class Topic:
    """Something that clients look at: it is followed while there are any, and wakes them when it changes."""

    def __init__(self, look: Callable[[], int], pause: float, pool: ThreadPoolExecutor) -> None:
        """`look` looks once and returns the version of what it saw."""
        self._look = look
        self._pause = pause
        self._pool = pool
        self._version = 0
        self.changed = asyncio.Event()  # is set at the next change, and then another takes its place
        self._looking: asyncio.Task[None] | None = None
        self._following: asyncio.Task[None] | None = None
        self.clients = 0
        self.closed = False

    def begin(self) -> "asyncio.Task[None]":
        """Begins to look, in a thread; who comes while that goes on shares it."""
        if self._looking is None or self._looking.done():
            self._looking = asyncio.create_task(self._look_once())
        return self._looking

    async def look(self) -> None:
        """Looks once."""
        await asyncio.shield(self.begin())

    @contextmanager
    def followed(self) -> Iterator[None]:
        """It is looked at again and again while the context lasts."""
        self.clients += 1
        if self._following is None or self._following.done():
            self._following = asyncio.create_task(self._follow())
        try:
            yield
        finally:
            self.clients -= 1

    def close(self) -> None:
        """Wakes all clients: there will be no more."""
        self.closed = True
        self._wake()

    async def _follow(self) -> None:
        while self.clients and not self.closed:
            await self.look()
            await asyncio.sleep(self._pause)

    async def _look_once(self) -> None:
        version = await asyncio.get_running_loop().run_in_executor(self._pool, self._look)
        if version != self._version:
            self._version = version
            self._wake()

    def _wake(self) -> None:
        self.changed.set()
        self.changed = asyncio.Event()


class Board:
    """The runs below a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._pool = ThreadPoolExecutor(_THREADS, "dashboard")
        self._watches: dict[str, Watch] = {}
        self._topics: dict[str, tuple[Watch, Topic]] = {}
        self._seeking = threading.Lock()
        self._seek_at = 0.0  # time.monotonic() of the next search for runs
        self._due: dict[str, float] = {}  # when each run of the list is to be looked at again
        self.version = 0
        self.data = b"{}"
        self.list = Topic(self._look_at_all, _LIST, self._pool)

    async def run(self, id: str) -> tuple[Watch, Topic] | None:
        """A run and who looks at it; None if there is none of that id."""
        if id not in self._watches and time.monotonic() >= self._seek_at:
            await self.call(self._seek)
        watch = self._watches.get(id)
        if watch is None:
            return None
        known = self._topics.get(id)
        if known is None or known[0] is not watch:  # a run that was gone for a while has another watch
            known = self._topics[id] = (watch, Topic(watch.look, _LOOK, self._pool))
        return known

    async def call(self, work: Callable[..., _Answer], *arguments: Any) -> _Answer:
        """Does work that reads files, in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, work, *arguments)

    def close(self) -> None:
        """Wakes all clients, for the last time."""
        for topic in (self.list, *(topic for _, topic in self._topics.values())):
            topic.close()

    def _seek(self) -> None:
        """Takes up runs that are new and drops those that are gone and that nobody looks at."""
        with self._seeking:
            begun = time.monotonic()
            found = discover(self.root)
            took = time.monotonic() - begun
            self._seek_at = begun + took + max(_SEEK[0], _SEEK[1] * took)
            old = self._watches
            kept = {id: watch for id, watch in old.items() if id in found or self._looked_at(id)}
            self._watches = kept | {id: Watch(place) for id, place in found.items() if id not in old}

    def _looked_at(self, id: str) -> bool:
        known = self._topics.get(id)
        return known is not None and known[1].clients > 0

    def _look_at_all(self) -> int:
        """One look at the list, as far as its time goes. Returns its version."""
        start = time.monotonic()
        if start >= self._seek_at:
            self._seek()
        watches = self._watches
        for id in sorted(watches, key=lambda id: self._due.get(id, 0.0)):
            now = time.monotonic()
            if self._due.get(id, 0.0) > start or now - start > _BUDGET:
                break
            watches[id].look_for_row()
            self._due[id] = now if watches[id].running else now + _REST * len(watches)
        rows = [watch.snapshot.row for watch in watches.values()]
        data = encode({"folder": str(self.root), "runs": sorted(rows, key=_newest)})
        if data != self.data:
            self.data, self.version = data, self.version + 1
        return self.version


def _newest(row: dict[str, Any]) -> tuple[float, str]:
    return -(row["created"] or 0.0), row["name"]
