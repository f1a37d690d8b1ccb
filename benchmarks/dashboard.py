"""Is the dashboard of a very large run as quick as that of a small one?

    python -m benchmarks.dashboard [--blocks 1000] [--events 2000000] [--clients 200] [--folder FOLDER]
    python -m benchmarks.dashboard --quick

Serves a generated run (`simulated_run`, kept in FOLDER if that is given) with `panolog dashboard`, opens its
page as a browser does, with every file and every request, once with the run out of the page cache and once
more; then plays a driver whose blocks all report once a second, and times single records on their way
to a client, alone and among others. The exit code is 1 if a goal is missed.
"""

import argparse
import asyncio
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import httpx

from benchmarks.simulated_run import RATES, Size, write_run
from benchmarks.table import markdown
from panolog.orchestrator.dashboard.places import Place
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Noticed, Progressed
from panolog.orchestrator.run.state import block_task
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError

FIRST_PAGE, ON_ITS_WAY, MEMORY = 1.5, 1.0, 300.0  # goals: seconds, seconds, MB
_CONNECTIONS = 6  # of a browser to one server
_ASKED = ("events?limit=200", "previews", "views", "map", "series?task=coarse&points=600")
_REFERENCE = re.compile(r'(?:src|href)="(/static/[^"]+)"')
_IMPORT = re.compile(r'^(?:import|export) .*?from "\./([^"]+)"', re.MULTILINE)
_PATIENCE = 30.0  # seconds for anything


@dataclass(frozen=True)
class Report:
    """Seconds and MB."""

    cold: float  # the first page after the start of the server, its files not in memory
    warm: float  # the same once more
    alone: list[float]  # records on their way to a client
    among: list[float]  # the same among many clients
    clients: int
    memory: float  # the server's peak
    database: float

    @property
    def good(self) -> bool:
        """Whether all goals are met."""
        pages, ways = max(self.cold, self.warm), max(self.alone + self.among)
        return pages < FIRST_PAGE and ways < ON_ITS_WAY and self.memory < MEMORY


async def measure(folder: RunFolder, size: Size, clients: int, records: int) -> Report:
    """Serves the parent of a run folder and looks at it."""
    place = Place(folder.root.parent, folder.root.name)
    _forget(folder.root)
    async with AsyncExitStack() as stack:
        pid, url = await stack.enter_async_context(_served(place.root))
        limits = httpx.Limits(max_connections=None)
        client = httpx.AsyncClient(base_url=url, timeout=_PATIENCE, limits=limits)
        session = await stack.enter_async_context(client)
        cold = await _open_page(session, place.id)
        warm = await _open_page(session, place.id)
        with lock.hold(folder.lock), closing(Database(folder.database)) as database:
            driver = Driver(database, size)
            alone = await driver.time_records(session, place.id, records)
            others = [asyncio.create_task(_listen(url, place.id)) for _ in range(clients)]
            await asyncio.sleep(2)  # they all have their first message
            among = await driver.time_records(session, place.id, records)
            for other in others:
                other.cancel()
            await asyncio.gather(*others, return_exceptions=True)
        memory = _peak(pid)
    return Report(cold, warm, alone, among, clients, memory, folder.database.stat().st_size / 1e6)


class Driver:
    """Plays a driver: all blocks that train report once a second."""

    def __init__(self, database: Database, size: Size) -> None:
        self._database = database
        self._names = [block_task(block) for block in range(size.blocks - size.together, size.blocks)]
        self._iteration = 15_000

    async def time_records(self, session: httpx.AsyncClient, id: str, count: int) -> list[float]:
        """Seconds from before a record is written until a client has it, at different times of a second."""
        work = asyncio.create_task(self._report())
        times = []
        async with session.stream("GET", f"/api/stream?run={id}&changes=1") as answer:
            lines = answer.aiter_lines()
            await anext(lines)
            for number in range(count):
                await asyncio.sleep(0.31)
                text = f"number {number} at {time.monotonic()}"
                begun = time.monotonic()
                self._database.append([Noticed("", text)])
                while text not in await asyncio.wait_for(anext(lines), _PATIENCE):
                    pass
                times.append(time.monotonic() - begun)
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        return times

    async def _report(self) -> None:
        while True:
            self._iteration += 9
            memory, loss, gaussians = 6_000_000_000, 0.07, 300_000
            self._database.append(
                [
                    Progressed(
                        name, self._iteration, 30_000, 9.0, loss, 25.0, gaussians, memory, memory, RATES
                    )
                    for name in self._names
                ]
            )
            await asyncio.sleep(1)


@asynccontextmanager
async def _served(folder: Path) -> AsyncIterator[tuple[int, str]]:
    """`panolog dashboard`: its process and its address."""
    command = [sys.executable, "-c", "from panolog.orchestrator.cli.app import main; main()"]
    process = await asyncio.create_subprocess_exec(
        *command, "dashboard", str(folder), "--port", "0", stderr=asyncio.subprocess.PIPE
    )
    assert process.stderr is not None
    try:
        url = (await asyncio.wait_for(process.stderr.readline(), _PATIENCE)).decode().strip()
        if not url.startswith("http://"):
            raise RunError(f"the dashboard did not start: {url}")
        yield process.pid, url
    finally:
        process.terminate()
        await process.wait()


async def _open_page(session: httpx.AsyncClient, id: str) -> float:
    """Seconds until a page has everything, with as many connections as a browser has."""
    room, begun = asyncio.Semaphore(_CONNECTIONS - 1), time.monotonic()
    seen: set[str] = set()

    async def fetch(path: str) -> str:
        async with room:
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
            await asyncio.gather(*(load(f"/static/{name}") for name in _IMPORT.findall(text)))

    html = await fetch(f"/runs/{id}")
    await asyncio.gather(load("/static/plotly.min.js"), *map(load, _REFERENCE.findall(html)))
    async with session.stream("GET", f"/api/stream?run={id}&changes=1") as answer:
        lines = answer.aiter_lines()
        while not (await asyncio.wait_for(anext(lines), _PATIENCE)).startswith("data: "):
            pass
        await asyncio.gather(*(fetch(f"/api/runs/{id}/{path}") for path in _ASKED))
    return time.monotonic() - begun


async def _listen(url: str, id: str) -> None:
    """A client that takes what comes and does not look at it: the measuring must not be what takes time."""
    host, _, port = url.strip("/").removeprefix("http://").partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(f"GET /api/stream?run={id}&changes=1 HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    try:
        while await reader.read(1 << 20):
            pass
    finally:
        writer.close()


def _forget(folder: Path) -> None:
    """Asks the kernel to drop the run's files from the page cache; what nobody has written it can drop."""
    for path in folder.rglob("*"):
        if path.is_file():
            handle = os.open(path, os.O_RDONLY)
            os.fsync(handle)
            os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(handle)


def _peak(pid: int) -> float:
    """MB that a process has had resident at most."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1e3


def table(report: Report) -> str:
    """For people."""
    rows: list[tuple[object, ...]] = [
        ("first page, run not in memory, s", report.cold, f"< {FIRST_PAGE}"),
        ("the same once more, s", report.warm, f"< {FIRST_PAGE}"),
        ("record to client: median s", median(report.alone), ""),
        ("record to client: longest s", max(report.alone), f"< {ON_ITS_WAY}"),
        (f"with {report.clients} other clients: median s", median(report.among), ""),
        (f"with {report.clients} other clients: longest s", max(report.among), f"< {ON_ITS_WAY}"),
        ("memory of the server, peak MB", report.memory, f"< {MEMORY:.0f}"),
        ("run.db, MB", report.database, ""),
    ]
    return markdown(("what", "measured", "goal"), rows)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.dashboard", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--blocks", type=int, default=1000)
    parser.add_argument("--events", type=int, default=2_000_000)
    parser.add_argument("--together", type=int, default=100, help="blocks that train at a time")
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--records", type=int, default=40, help="that are timed on their way")
    parser.add_argument("--folder", type=Path, help="of the generated run; is made once and kept")
    parser.add_argument("--quick", action="store_true", help="small: to see that it works")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    options = parser.parse_args(arguments)
    if options.quick:
        options.blocks, options.events, options.together = 12, 5_000, 4
        options.clients, options.records = 5, 3
    return options


def main() -> int:
    """The program; returns its exit code."""
    options = parse()
    size = Size(options.blocks, options.events, options.together)
    with tempfile.TemporaryDirectory(prefix="dashboard-") as temporary:
        root = (options.folder or Path(temporary)).absolute() / "run"
        folder = RunFolder(root) if root.exists() else write_run(root, size)
        report = asyncio.run(measure(folder, size, options.clients, options.records))
    if options.json:
        print(json.dumps({"size": asdict(size), "report": asdict(report), "good": report.good}, indent=2))
    else:
        print(f"{size.blocks:,} blocks, {size.events:,} events", end="\n\n")
        print(table(report))
    return int(not report.good)


if __name__ == "__main__":
    sys.exit(main())
