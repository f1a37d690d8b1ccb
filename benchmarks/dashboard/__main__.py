"""Response times and memory of the dashboard of a very large run, against goals.

    python -m benchmarks.dashboard [--blocks 1000] [--events 2000000] [--clients 200] [--folder FOLDER]
    python -m benchmarks.dashboard --quick

Serves a generated run (`simulated_run`, kept in FOLDER if that is given) with `panolog dashboard`, opens its
page as a browser does, with every file and every request, first with the run out of the page cache, then
again. Then it simulates a driver whose blocks all report once a second, and times single records from the
database to a client, first alone, then with other clients. The exit code is 1 if a goal is missed.
"""

import asyncio
import re
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from urllib.parse import urljoin

import httpx

from benchmarks import report
from benchmarks.dashboard.simulated_run import RATES, RunSize, write_run
from benchmarks.processes import drop_from_page_cache, peak_memory
from benchmarks.runs import BIN
from panolog.orchestrator.dashboard.discovery import RunEntry
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Noticed, Progressed
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError
from panolog.workers.tasks import TaskId

FIRST_PAGE, DELAY, MEMORY = 1.5, 1.0, 300.0  # goals: seconds, seconds, MB
_CONNECTIONS = 6  # of a browser to one server
_REQUESTS = ("events?limit=200", "previews", "views", "map", "series?task=coarse&points=600")
_REFERENCE = re.compile(r'(?:src|href)="(/static/[^"]+)"')
_IMPORT = re.compile(r'^import .*? from "([^"]+)"', re.MULTILINE)
_TIMEOUT_S = 30.0  # for any answer


@dataclass(frozen=True)
class DashboardMeasurement:
    """Seconds and MB."""

    cold: float  # the first page after the start of the server, its files not in memory
    warm: float  # the same again
    alone: list[float]  # from the write of a record until a client has it
    among: list[float]  # the same with many other clients
    clients: int
    memory: float  # the server's peak
    database: float

    @property
    def good(self) -> bool:
        """Whether all goals are met."""
        pages, delays = max(self.cold, self.warm), max(self.alone + self.among)
        return pages < FIRST_PAGE and delays < DELAY and self.memory < MEMORY


async def measure(folder: RunFolder, size: RunSize, clients: int, records: int) -> DashboardMeasurement:
    """Serves the parent of a run folder and measures the requests of its page."""
    entry = RunEntry(folder.root.parent, folder.root.name)
    for path in folder.root.rglob("*"):
        if path.is_file():
            drop_from_page_cache(path)
    async with AsyncExitStack() as stack:
        pid, url = await stack.enter_async_context(_served(entry.root))
        limits = httpx.Limits(max_connections=None)
        client = httpx.AsyncClient(base_url=url, timeout=_TIMEOUT_S, limits=limits)
        session = await stack.enter_async_context(client)
        cold = await _open_page(session, entry.id)
        warm = await _open_page(session, entry.id)
        with lock.hold(folder.lock), closing(Database(folder.database)) as database:
            driver = SimulatedDriver(database, size)
            alone = await driver.time_records(session, entry.id, records)
            others = [asyncio.create_task(_listen(url, entry.id)) for _ in range(clients)]
            await asyncio.sleep(2)  # they all have their first message
            among = await driver.time_records(session, entry.id, records)
            for other in others:
                other.cancel()
            await asyncio.gather(*others, return_exceptions=True)
        memory = peak_memory(pid) / 1e6
    return DashboardMeasurement(
        cold, warm, alone, among, clients, memory, folder.database.stat().st_size / 1e6
    )


class SimulatedDriver:
    """Simulated driver: all blocks that train report once a second."""

    def __init__(self, database: Database, size: RunSize) -> None:
        self._database = database
        self._names = [TaskId.block(block) for block in range(size.blocks - size.together, size.blocks)]
        self._iteration = 15_000

    async def time_records(self, session: httpx.AsyncClient, id: str, count: int) -> list[float]:
        """Seconds from the write of a record until a client has it, at different times of a second."""
        work = asyncio.create_task(self._report())
        times = []
        async with session.stream("GET", f"/api/stream?run={id}&changes=1") as answer:
            lines = answer.aiter_lines()
            await anext(lines)
            for number in range(count):
                await asyncio.sleep(0.31)
                text = f"number {number} at {time.monotonic()}"
                begun = time.monotonic()
                self._database.append([Noticed(None, text)])
                while text not in await asyncio.wait_for(anext(lines), _TIMEOUT_S):
                    pass
                times.append(time.monotonic() - begun)
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        return times

    async def _report(self) -> None:
        while True:
            self._iteration += 9
            memory, loss, gaussians = 6_000_000_000, 0.07, 300_000
            fields = (self._iteration, 30_000, 9.0, loss, 25.0, gaussians, memory, memory, RATES)
            self._database.append([Progressed(name, *fields) for name in self._names])
            await asyncio.sleep(1)


@asynccontextmanager
async def _served(folder: Path) -> AsyncIterator[tuple[int, str]]:
    """`panolog dashboard`: its process and its address."""
    command = [str(BIN / "panolog"), "dashboard", str(folder), "--port", "0"]
    process = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
    assert process.stderr is not None
    try:
        url = (await asyncio.wait_for(process.stderr.readline(), _TIMEOUT_S)).decode().strip()
        if not url.startswith("http://"):
            raise RunError(f"the dashboard did not start: {url}")
        yield process.pid, url
    finally:
        process.terminate()
        await process.wait()


async def _open_page(session: httpx.AsyncClient, id: str) -> float:
    """Seconds until a page has everything, with as many connections as a browser has."""
    slots, begun = asyncio.Semaphore(_CONNECTIONS - 1), time.monotonic()
    seen: set[str] = set()

    async def fetch(path: str) -> str:
        async with slots:
            answer = await session.get(path)
        answer.raise_for_status()
        return answer.text

    async def load(path: str) -> None:
        """A file and all modules that it needs."""
        if path in seen:
            return
        seen.add(path)
        text = await fetch(path)
        if path.endswith(".js") and not path.endswith(".min.js"):
            await asyncio.gather(*(load(urljoin(path, name)) for name in _IMPORT.findall(text)))

    html = await fetch(f"/runs/{id}")
    await asyncio.gather(load("/static/plotly.min.js"), *map(load, _REFERENCE.findall(html)))
    async with session.stream("GET", f"/api/stream?run={id}&changes=1") as answer:
        lines = answer.aiter_lines()
        while not (await asyncio.wait_for(anext(lines), _TIMEOUT_S)).startswith("data: "):
            pass
        await asyncio.gather(*(fetch(f"/api/runs/{id}/{path}") for path in _REQUESTS))
    return time.monotonic() - begun


async def _listen(url: str, id: str) -> None:
    """A client that reads and discards, so that the measurement itself takes little time."""
    host, _, port = url.strip("/").removeprefix("http://").partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(f"GET /api/stream?run={id}&changes=1 HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    try:
        while await reader.read(1 << 20):
            pass
    finally:
        writer.close()


def table(measured: DashboardMeasurement) -> str:
    """In Markdown."""
    others = f"with {measured.clients} other clients"
    rows: list[tuple[object, ...]] = [
        ("first page, run not in memory, s", measured.cold, f"< {FIRST_PAGE}"),
        ("the same again, s", measured.warm, f"< {FIRST_PAGE}"),
        ("record to client: median s", median(measured.alone), ""),
        ("record to client: longest s", max(measured.alone), f"< {DELAY}"),
        (f"{others}: median s", median(measured.among), ""),
        (f"{others}: longest s", max(measured.among), f"< {DELAY}"),
        ("memory of the server, peak MB", measured.memory, f"< {MEMORY:.0f}"),
        ("run.db, MB", measured.database, ""),
    ]
    return report.markdown(("what", "measured", "goal"), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if a goal is missed."""
    parser = report.parser("dashboard", __doc__)
    parser.add_argument("--blocks", type=int, default=1000)
    parser.add_argument("--events", type=int, default=2_000_000)
    parser.add_argument("--together", type=int, default=100, help="blocks that train at a time")
    parser.add_argument("--cameras", type=int, default=0, help="of the plan; by default two for each block")
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--records", type=int, default=40, help="whose delay is measured")
    parser.add_argument("--folder", type=Path, help="of the generated run; is made once and kept")
    options = parser.parse_args(arguments)
    if options.quick:
        options.blocks, options.events, options.together = 12, 5_000, 4
        options.clients, options.records = 5, 3
    size = RunSize(options.blocks, options.events, options.together, options.cameras)

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="dashboard-") as temporary:
            root = (options.folder or Path(temporary)).absolute() / "run"
            folder = RunFolder(root) if root.exists() else write_run(root, size)
            measured = asyncio.run(measure(folder, size, options.clients, options.records))
        content = {"size": asdict(size), "report": asdict(measured), "good": measured.good}
        title = f"{size.blocks:,} blocks, {size.events:,} events"
        return report.Report(content, f"{title}\n\n{table(measured)}", passed=measured.good)

    return report.run("dashboard", options, work)


if __name__ == "__main__":
    sys.exit(main())
