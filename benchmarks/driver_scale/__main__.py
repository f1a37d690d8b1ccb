"""The real driver with very many blocks and simulated workers: CPU, memory, lost events, time of `status`.

    python -m benchmarks.driver_scale [--blocks 1000] [--workers 200] [--rate 10] [--seconds 12] [--json]

A whole run goes through the real driver, its database and its files; only the pool is simulated: it sends the
messages of that many workers by the clock. Meanwhile another process requests the run's `status` repeatedly,
as a function call and as a command. Every event must reach the driver's observer, once and in order, and what
`thinning` keeps of progress must be in the database.
"""

import os
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.driver_scale.simulated_pool import SimulatedPool, grid
from benchmarks.driver_scale.status_requests import Times, request_status
from benchmarks.processes import fresh_process, peak_memory
from benchmarks.runs import history
from panolog.orchestrator.engine.driver.driver import Driver
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.runs import folder as run_folder
from panolog.orchestrator.runs import info, lock
from panolog.orchestrator.runs.config import PassesConfig, RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import SceneRef
from panolog.orchestrator.runs.records import Merged, PlanSaved, Progressed, RunBegan, Stored
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.runs.store import Database
from panolog.orchestrator.runs.thinning import DENSE
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town
from panolog.workers.tasks import TaskId

WIDTH = 64  # pixels of the town, which is not trained on


@dataclass(frozen=True)
class Load:
    """What is simulated."""

    blocks: int
    workers: int
    rate: float  # events per second of each worker
    seconds: float  # of a block's training, on average


@dataclass(frozen=True)
class DriverMeasurement:
    """The driver while blocks were trained."""

    seconds: float
    events: int  # sent by workers in the whole run
    lost: int  # of them that the driver has not shown, or not stored though it keeps them
    late: float  # longest wait of an event for the driver, seconds
    cpu: float  # of the driver, as a fraction of one core
    memory: float  # peak of the driver's process, 1e6 bytes
    database: float  # size at the end, 1e6 bytes
    status: Times


class Stopwatch:
    """Observer of all records, as a display is, that times the blocks."""

    def __init__(self, pool: SimulatedPool) -> None:
        self._pool = pool
        self._began = (0.0, 0.0)
        self.seconds = 0.0
        self.cpu = 0.0  # seconds of this process without those of the simulation
        self.seen: Counter[TaskId] = Counter()  # events of progress that came once each and in order

    def show(self, _: RunState, news: Sequence[Stored]) -> None:
        """From the plan to the merge."""
        for stored in news:
            record = stored.record
            if isinstance(record, Progressed) and record.iteration == self.seen[record.task] + 1:
                self.seen[record.task] += 1
            if isinstance(stored.record, PlanSaved):
                self._began = self._now()
            if isinstance(stored.record, Merged):
                wall, cpu = self._now()
                self.seconds, self.cpu = wall - self._began[0], cpu - self._began[1]

    def _now(self) -> tuple[float, float]:
        return time.perf_counter(), time.process_time() - self._pool.cpu


def measure(folder: Path, load: Load) -> DriverMeasurement:
    """Simulates a run in `folder`. Raises RunError if `status` fails, and what the driver raises."""
    job = prepare(folder, load)
    pool = SimulatedPool(load.workers, load.rate, load.seconds)
    watch = Stopwatch(pool)
    began = RunBegan(socket.gethostname(), os.getpid(), resumed=False)
    with fresh_process() as process:
        with lock.hold(job.folder.lock), closing(Database(job.folder.database)) as database:
            status = process.submit(request_status, job.folder.root)  # ends with the lock
            database.append([began])
            Driver(job, Journal(database, watch.show), pool).run()
        times = status.result()
    return DriverMeasurement(
        seconds=watch.seconds,
        events=sum(pool.sent.values()),
        lost=sum((pool.sent - watch.seen).values()) + lost(pool.sent, history(job.folder.root)),
        late=pool.late,
        cpu=watch.cpu / watch.seconds,
        memory=peak_memory() / 1e6,
        database=job.folder.database.stat().st_size / 1e6,
        status=times,
    )


def prepare(folder: Path, load: Load) -> Job:
    """A run that has not begun, of a town whose panoramas are never read."""
    scene = read_scene(make_town(folder / "town", panoramas=9, width=WIDTH, points=300))
    blocks, passes = str(grid(load.blocks)), PassesConfig()
    config = RunConfig(width=WIDTH, device="cpu", blocks=blocks, passes=passes)
    root = RunFolder(folder / "run")
    run_folder.make(root.root)
    reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
    info.write_info(root, info.make_info(reference, config))
    return Job(root, scene, config)


def lost(sent: Mapping[TaskId, int], records: Sequence[Stored]) -> int:
    """How many events of each task, numbered from 1, the history must have, once and in order, and has not.

    These are the first `thinning.DENSE` and the last; of the others it may have any.
    """
    seen: dict[TaskId, list[int]] = {task: [] for task in sent}
    for stored in records:
        record = stored.record
        if isinstance(record, Progressed) and record.iteration > max(seen[record.task], default=0):
            seen[record.task].append(record.iteration)
    return sum(
        len({*range(1, min(count, DENSE) + 1), count} - {0, *seen[task]}) for task, count in sent.items()
    )


def table(measured: DriverMeasurement) -> str:
    """In Markdown."""
    rows: list[tuple[object, ...]] = [
        ("events", measured.events, ""),
        ("events lost", measured.lost, ""),
        ("seconds of the blocks", measured.seconds, ""),
        ("longest wait of an event, s", measured.late, ""),
        ("driver CPU, cores", measured.cpu, ""),
        ("driver memory, peak MB", measured.memory, ""),
        ("run.db, MB", measured.database, ""),
    ]
    for kind, times in measured.status.items():
        rows.append((f"status, {kind}: median ms", times["median"], f"{times['count']:.0f} times"))
        rows.append((f"status, {kind}: longest ms", times["longest"], ""))
    return report.markdown(("what", "measured", ""), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code: 1 if an event was lost."""
    parser = report.parser("driver_scale", __doc__)
    parser.add_argument("--blocks", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--rate", type=float, default=10, help="events of each worker, per second")
    parser.add_argument("--seconds", type=float, default=12, help="duration of a block, on average")
    parser.add_argument("--folder", type=Path, help="on the disk to write to; by default that of TMPDIR")
    options = parser.parse_args(arguments)
    if options.quick:
        options.blocks, options.workers, options.seconds = 12, 4, 1.0
    load = Load(options.blocks, options.workers, options.rate, options.seconds)

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="driver-", dir=options.folder) as folder:
            measured = measure(Path(folder), load)
        title = f"{load.blocks:,} blocks, {load.workers} workers, {load.rate:g} events a second of each"
        content = {"load": asdict(load), "report": asdict(measured)}
        return report.Report(content, f"{title}\n\n{table(measured)}", passed=measured.lost == 0)

    return report.run("driver_scale", options, work)


if __name__ == "__main__":
    sys.exit(main())
