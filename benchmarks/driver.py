"""The driver with very many blocks and workers, killed in the middle and resumed.

    python -m benchmarks.driver [--json]

Driver, database, files and `panolog status` are real; workers are simulated, and their messages come by the
clock (`simulated_pool`). The driver ends when half of the blocks are done, as after a crash, and another
resumes the run.
"""

import os
import socket
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from benchmarks import report
from benchmarks.processes import in_fresh_process, peak_memory
from benchmarks.runs import BIN, history
from benchmarks.simulated_pool import SimulatedPool
from panolog.orchestrator.engine.driver.driver import Driver
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs import folder as run_folder
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.config import PassesConfig, RunConfig
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import SceneRef, make_info, read_info, write_info
from panolog.orchestrator.runs.records import ModelSaved, Progressed, RunBegan, Stored, TaskStarted
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.runs.thinning import DENSE
from panolog.partition.cells import Grid
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town
from panolog.workers.tasks import Stage, TaskId

_STATUS = 3  # commands, of which the median counts
_WIDTH = 64  # pixels of the town, which is not trained on


class _HaltedError(RuntimeError):
    """Ends a driver in the middle of its run."""


@dataclass(frozen=True)
class Load:
    """What is simulated."""

    grid: Grid
    workers: int
    rate: float  # events per second of each worker
    seconds: float  # of a block's training, on average


WHOLE = Load(Grid((25, 20, 20)), 2_000, 0.2, 60.0)
SMALL = Load(Grid((3, 2, 2)), 4, 10.0, 0.5)


@dataclass(frozen=True)
class Phase:
    """One driver, from the opening of its database to its end."""

    seconds: float
    full: float  # seconds until as many blocks as there are workers had started; 0 if they never had
    cpu: float  # seconds, without those of the simulation
    messages: int  # of progress
    lost: int  # of them that no observer of the run has seen, or that are not stored though they are kept
    late: float  # longest wait of a message, seconds
    turn: float  # most CPU seconds of the driver between two looks for messages
    memory: float  # peak, 1e6 bytes


@dataclass(frozen=True)
class DriverScale:
    """A whole run, by two drivers."""

    load: Load
    first: Phase  # until half of the blocks were done
    resumed: Phase
    status: float  # seconds of the command, the run being halted
    database: float  # 1e6 bytes at the end

    def rows(self) -> list[tuple[str, object]]:
        """What was measured, by what it is."""
        load, first, resumed = self.load, self.first, self.resumed
        cpu = first.cpu + resumed.cpu
        return [
            ("blocks, workers", f"{load.grid.count:,}, {load.workers:,}"),
            ("messages a second of each worker, seconds of a block", f"{load.rate:g}, {load.seconds:g}"),
            ("messages of progress", first.messages + resumed.messages),
            ("of them lost after the resume", resumed.lost),
            (
                "seconds until half of the blocks were done, and of the rest",
                f"{first.seconds:.1f}, {resumed.seconds:.1f}",
            ),
            (
                "seconds until all workers had a block: at first, after the resume",
                f"{first.full:.1f}, {resumed.full:.1f}",
            ),
            ("CPU of both drivers, s", cpu),
            ("CPU of a block with its messages, ms", 1e3 * cpu / load.grid.count),
            ("longest wait of a message, s", max(first.late, resumed.late)),
            ("longest turn of the driver's loop, CPU s", max(first.turn, resumed.turn)),
            ("memory of a driver, peak MB", max(first.memory, resumed.memory)),
            ("run.db, MB", self.database),
            ("`panolog status --json`, s", self.status),
        ]


class _Watch:
    """Observes all records, as a display does; ends the driver when so many blocks are done."""

    def __init__(self, workers: int, halt: int | None) -> None:
        self._workers, self._halt = workers, halt
        self._begun = time.perf_counter()
        self._started = self._done = 0
        self.full = 0.0  # seconds until all workers had work
        self.seen: Counter[TaskId] = Counter()  # events of progress that came once each and in order

    def show(self, _: RunState, news: Sequence[Stored]) -> None:
        """Called with what is new. Raises once."""
        for stored in news:
            record = stored.record
            if isinstance(record, Progressed) and record.iteration == self.seen[record.task] + 1:
                self.seen[record.task] += 1
            if isinstance(record, TaskStarted | ModelSaved) and record.task.stage is Stage.BLOCK:
                self._started += isinstance(record, TaskStarted)
                self._done += isinstance(record, ModelSaved)
        if self._started >= self._workers and not self.full:
            self.full = time.perf_counter() - self._begun
        if self._halt is not None and self._done >= self._halt:
            self._halt = None
            raise _HaltedError("half of the blocks are done")


def measure(folder: Path, load: Load) -> DriverScale:
    """Runs `load` in a folder. Raises what the driver raises."""
    first = in_fresh_process(_drive, folder, load, halt=True)
    root = folder / "run"
    command = [str(BIN / "panolog"), "status", str(root), "--json"]
    status = median(_seconds(command) for _ in range(_STATUS))
    resumed = in_fresh_process(_drive, folder, load, halt=False)
    return DriverScale(load, first, resumed, status, RunFolder(root).database.stat().st_size / 1e6)


def _seconds(command: Sequence[str]) -> float:
    began = time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def _drive(folder: Path, load: Load, *, halt: bool) -> Phase:
    """One driver, in this process. Raises what it raises, but for the end that it is to have."""
    root = RunFolder(folder / "run")
    if halt:
        _prepare(folder, root, load)
    pool = SimulatedPool(load.workers, load.rate, load.seconds)
    watch = _Watch(min(load.workers, load.grid.count), load.grid.count // 2 if halt else None)
    began, cpu = time.perf_counter(), time.process_time()
    info = read_info(root)
    with lock.hold(root.lock), closing(Database(root.database)) as database:
        journal = Journal(database, watch.show)
        journal.record([RunBegan(socket.gethostname(), os.getpid(), resumed=not halt)])
        try:
            Driver(Job(root, scene_of(info, root), info.config), journal, pool).run()
        except _HaltedError:
            if not halt:
                raise
    return Phase(
        seconds=time.perf_counter() - began,
        full=watch.full,
        cpu=time.process_time() - cpu - pool.cpu,
        messages=sum(pool.sent.values()),
        lost=0 if halt else sum((pool.sent - watch.seen).values()) + lost(pool.sent, history(root.root)),
        late=pool.late,
        turn=pool.turn,
        memory=peak_memory() / 1e6,
    )


def _prepare(folder: Path, root: RunFolder, load: Load) -> None:
    """Makes a run that has not begun, of a town whose panoramas are never read."""
    scene = read_scene(make_town(folder / "town", panoramas=9, width=_WIDTH, points=300))
    config = RunConfig(width=_WIDTH, device="cpu", blocks=str(load.grid), passes=PassesConfig())
    run_folder.make(root.root)
    reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
    write_info(root, make_info(reference, config))


def lost(sent: Mapping[TaskId, int], records: Sequence[Stored]) -> int:
    """How many events of each task, numbered from 1, the history must have, once and in order, and has not.

    These are the first `thinning.DENSE` and the last; of the others it may have any.
    """
    seen = defaultdict[TaskId, list[int]](list)
    for stored in records:
        record = stored.record
        if isinstance(record, Progressed) and record.iteration > max(seen[record.task], default=0):
            seen[record.task].append(record.iteration)
    return sum(
        len({*range(1, min(count, DENSE) + 1), count} - {0, *seen[task]}) for task, count in sent.items()
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("driver", __doc__)
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        with TemporaryDirectory(prefix="panolog-driver-") as folder:
            found = measure(Path(folder), SMALL if options.quick else WHOLE)
        return report.Report(asdict(found), report.markdown(("what", "measured"), found.rows()))

    return report.run("driver", options, work)


if __name__ == "__main__":
    sys.exit(main())
