"""What the driver makes of very many blocks and workers: the real driver, told of by simulated ones.

    python -m benchmarks.driver_scale [--blocks 1000] [--workers 200] [--rate 10] [--seconds 12] [--json]

A whole run goes through the real driver, its database and its files; only the pool is played: it says by the
clock what so many workers would. Meanwhile another process asks for the run's `status` again and again, as a
function call and as a command. Afterwards every event must be in the database.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.merge_process import peak
from benchmarks.report import machine
from benchmarks.runs import history
from benchmarks.simulated_pool import SimulatedPool
from benchmarks.table import markdown
from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.run import folder as run_folder
from panolog.orchestrator.run import info, lock
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import SceneRef
from panolog.orchestrator.run.records import Merged, PlanSaved, Progressed, RunBegan, Stored
from panolog.orchestrator.run.state import RunState
from panolog.orchestrator.run.store import Database
from panolog.partition.cells import Grid
from panolog.scene.errors import RunError
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town

WIDTH = 64  # pixels of the town: nobody trains on it
_PATIENCE = 60.0  # seconds for the last answers to `status`


@dataclass(frozen=True)
class Load:
    """What is simulated."""

    blocks: int
    workers: int
    rate: float  # events per second of each worker
    seconds: float  # of a block's training, on average


@dataclass(frozen=True)
class Report:
    """What was measured, while blocks were trained."""

    seconds: float
    events: int  # said by workers in the whole run
    lost: int  # of them not in the database
    late: float  # longest wait of an event for the driver, seconds
    cpu: float  # of the driver, as a fraction of one core
    memory: float  # peak of the driver's process, 1e6 bytes
    database: float  # size at the end, 1e6 bytes
    status: dict[str, dict[str, float]]  # milliseconds by way of asking, see `status_times`


class Stopwatch:
    """Is told of all records, as a display is, and times the blocks."""

    def __init__(self, pool: SimulatedPool) -> None:
        self._pool = pool
        self._began = (0.0, 0.0)
        self.seconds = 0.0
        self.cpu = 0.0  # seconds of this process without those of the simulation

    def show(self, _: RunState, news: Sequence[Stored]) -> None:
        """From the plan to the merge."""
        for stored in news:
            if isinstance(stored.record, PlanSaved):
                self._began = self._now()
            if isinstance(stored.record, Merged):
                wall, cpu = self._now()
                self.seconds, self.cpu = wall - self._began[0], cpu - self._began[1]

    def _now(self) -> tuple[float, float]:
        return time.perf_counter(), time.process_time() - self._pool.cpu


def measure(folder: Path, load: Load) -> Report:
    """Simulates a run in `folder`. Raises RunError if `status` fails, and whatever the driver raises."""
    job = prepare(folder, load)
    pool = SimulatedPool(load.workers, load.rate, load.seconds)
    watch = Stopwatch(pool)
    began = RunBegan(socket.gethostname(), os.getpid(), resumed=False)
    with (
        lock.hold(job.folder.lock),
        closing(Database(job.folder.database)) as database,
        _asking(job.folder.root) as status,
    ):
        Driver(job, database, pool, watch.show).run(began)
    return Report(
        seconds=watch.seconds,
        events=sum(pool.said.values()),
        lost=lost(pool.said, history(job.folder.root)),
        late=pool.late,
        cpu=watch.cpu / watch.seconds,
        memory=peak(),
        database=job.folder.database.stat().st_size / 1e6,
        status=status,
    )


def prepare(folder: Path, load: Load) -> Job:
    """A run that nobody has begun, of a town whose panoramas nobody will look at."""
    scene = read_scene(make_town(folder / "town", panoramas=9, width=WIDTH, points=300))
    config = RunConfig(width=WIDTH, device="cpu", blocks=str(grid(load.blocks)))
    root = RunFolder(folder / "run")
    run_folder.make(root.root)
    reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
    info.write_info(root, info.make_info(reference, config))
    return Job(root, scene, config)


def grid(blocks: int) -> Grid:
    """A grid of so many blocks, as cubic as it can be."""
    x = max(n for n in range(1, round(blocks ** (1 / 3)) + 1) if blocks % n == 0)
    rest = blocks // x
    y = max(n for n in range(1, int(rest**0.5) + 1) if rest % n == 0)
    return Grid((rest // y, y, x))


def lost(said: Mapping[str, int], records: Sequence[Stored]) -> int:
    """How many of the events that each task has said are not in the history, once each and in order."""
    heard: dict[str, int] = {}
    for stored in records:
        record = stored.record
        if isinstance(record, Progressed) and record.iteration == heard.get(record.task, 0) + 1:
            heard[record.task] = record.iteration
    return sum(count - heard.get(task, 0) for task, count in said.items())


@contextmanager
def _asking(root: Path) -> Iterator[dict[str, Any]]:
    """Asks for the run's status all the time; what came of it is in the dictionary afterwards."""
    command = [sys.executable, "-m", "benchmarks.status_times", str(root)]
    answers: dict[str, Any] = {}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as asker:
        try:
            yield answers
        finally:
            said, _ = asker.communicate(timeout=_PATIENCE)  # it goes on until its stdin is closed
    if asker.returncode:
        raise RunError(f"`status` failed while the run went on: {' '.join(command)}")
    answers.update(json.loads(said))


def table(report: Report) -> str:
    """For people."""
    rows: list[tuple[object, ...]] = [
        ("events", report.events, ""),
        ("events lost", report.lost, ""),
        ("seconds of the blocks", report.seconds, ""),
        ("longest wait of an event, s", report.late, ""),
        ("driver CPU, cores", report.cpu, ""),
        ("driver memory, peak MB", report.memory, ""),
        ("run.db, MB", report.database, ""),
    ]
    for way, times in report.status.items():
        rows.append((f"status, {way}: median ms", times["median"], f"{times['count']:.0f} times"))
        rows.append((f"status, {way}: longest ms", times["longest"], ""))
    return markdown(("what", "measured", ""), rows)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.driver_scale", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--blocks", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--rate", type=float, default=10, help="events of each worker, per second")
    parser.add_argument("--seconds", type=float, default=12, help="that a block takes, on average")
    parser.add_argument("--folder", type=Path, help="on the disk to write to; by default that of TMPDIR")
    parser.add_argument("--quick", action="store_true", help="small: to see that it works")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    options = parser.parse_args(arguments)
    if options.quick:
        options.blocks, options.workers, options.seconds = 12, 4, 1.0
    return options


def main() -> int:
    """The program; returns its exit code: 1 if an event was lost."""
    options = parse()
    load = Load(options.blocks, options.workers, options.rate, options.seconds)
    with tempfile.TemporaryDirectory(prefix="driver-", dir=options.folder) as folder:
        report = measure(Path(folder), load)
    if options.json:
        print(json.dumps({"machine": machine(), "load": asdict(load), "report": asdict(report)}, indent=2))
    else:
        what = f"{load.blocks:,} blocks, {load.workers} workers, {load.rate:g} events a second of each"
        print(what, end="\n\n")
        print(table(report))
    return int(report.lost > 0)


if __name__ == "__main__":
    sys.exit(main())
