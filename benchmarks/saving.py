"""Checkpoints of many tasks at once: the driver's memory, and the rate at which they reach the disk.

    python -m benchmarks.saving                       # 80 tasks, two checkpoints of 20 MB each
    python -m benchmarks.saving --tasks 20 --megabytes 200 --folder /runs --json

Simulated workers announce their checkpoints all at the same time, as after a request to stop, and hand real
bytes to the real driver. A plain loop writes the same bytes the same way, before and after, as the measure of
the disk. The exit code is 1 if more than two messages were in memory, or the rate is below half of that of
the loop.
"""

import os
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from mmap import mmap
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from benchmarks import report
from benchmarks.driver_scale.__main__ import Load, prepare
from benchmarks.driver_scale.simulated_pool import SimulatedPool, Timed, middles
from benchmarks.processes import in_fresh_process, peak_memory
from panolog.orchestrator.driver import writers
from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.resources.delivery import Large
from panolog.orchestrator.resources.pool import Message
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.records import CheckpointSaved, RunBegan, Stored
from panolog.orchestrator.run.state import RunState
from panolog.orchestrator.run.store import Database
from panolog.partition.cells import Cell
from panolog.workers.events import Checkpoint, Progress, Trained
from panolog.workers.tasks import COARSE, Stage, TaskId
from panolog.workers.training import checkpoint

ROUNDS = 2  # checkpoints of each task
_LEAST = 0.5  # of the plain loop's rate: two cores shared with other work leave no more to claim


@dataclass(frozen=True)
class SavingMeasurement:
    """One run of the driver with so many writers."""

    writers: int
    rate: float  # 1e6 bytes per second, from the first checkpoint taken to the last recorded
    most: int  # large messages in the driver's memory
    memory: float  # growth of the peak while they were written, in messages


class SavingPool(SimulatedPool):
    """Workers of blocks that send their checkpoints at once; a message has bytes from `take` on."""

    def __init__(self, tasks: int, size: int) -> None:
        """Args: size, bytes of a checkpoint."""
        super().__init__(tasks, 1.0, 0.0)
        self._size = size
        self._lock = threading.RLock()
        self._alive = self.most = 0
        self.first = 0.0  # time.monotonic() at which the first was taken
        self.before = 0  # peak bytes of the process until then

    def take(self, name: TaskId) -> Message:
        """A message of its own memory, which is counted."""
        message = super().take(name)
        if not isinstance(message, Checkpoint):
            return message
        if not self.first:
            self.first, self.before = time.monotonic(), peak_memory()
        message = replace(message, tensors={"x": _ones(self._size)})
        weakref.finalize(message, self._count, -1)
        self._count(1)
        return message

    def _count(self, change: int) -> None:
        with self._lock:
            self._alive += change
            self.most = max(self.most, self._alive)

    def _block(self, task: TaskId, cell: Cell) -> Iterator[Timed]:
        for i in range(1, ROUNDS + 1):
            yield 0.0, Progress(task, i, ROUNDS, 1.0)
            yield 0.0, Large(self._size)
            yield 0.0, Checkpoint(task, i, {})
        yield 0.0, Large(0)
        yield 0.0, Trained(task, middles([cell]), ROUNDS, 0.0)


def _ones(size: int) -> torch.Tensor:
    """A tensor of so many bytes, in memory that returns to the system with it.

    malloc would keep it: it returns only what is larger than 32 MB, as real checkpoints are (mallopt(3)).
    """
    array = np.frombuffer(mmap(-1, size), np.float32)
    array[:] = 1
    return torch.from_numpy(array)


def drive(folder: Path, tasks: int, size: int, threads: int) -> SavingMeasurement:
    """Runs the driver with so many writers. Raises RunError if the run fails."""
    job = prepare(folder, Load(tasks, tasks, 1.0, 0.0))
    pool, last, peak = SavingPool(tasks, size), 0.0, 0

    def show(_: RunState, news: Sequence[Stored]) -> None:
        nonlocal last, peak
        if any(isinstance(s.record, CheckpointSaved) and s.record.task.stage is Stage.BLOCK for s in news):
            last, peak = time.monotonic(), peak_memory()

    with (
        patch.object(writers, "LARGE", threads),
        lock.hold(job.folder.lock),
        closing(Database(job.folder.database)) as database,
    ):
        database.append([RunBegan("here", os.getpid(), resumed=False)])
        Driver(job, Journal(database, show), pool).run()
    rate = tasks * ROUNDS * size / (last - pool.first)
    growth = (peak - pool.before) / size
    return SavingMeasurement(threads, rate / 1e6, pool.most, growth)


def plain(folder: Path, count: int, size: int) -> float:
    """1e6 bytes per second of a loop that writes as many checkpoints, one after the other."""
    event = Checkpoint(COARSE, 1, {"x": torch.ones(size // 4)})
    began = time.monotonic()
    for number in range(count):
        checkpoint.save(folder / f"{number % (count // ROUNDS)}", event)
    return count * size / (time.monotonic() - began) / 1e6


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("saving", __doc__)
    parser.add_argument("--tasks", type=int, default=80)
    parser.add_argument("--megabytes", type=int, default=20, help="of a checkpoint")
    parser.add_argument("--writers", type=report.numbers, default=[1, 2, 4], help="threads to compare")
    parser.add_argument("--folder", type=Path, help="on the disk to write to; by default that of TMPDIR")
    options = parser.parse_args(arguments)
    if options.quick:
        options.tasks, options.megabytes = 8, 2
    size = options.megabytes * 10**6

    def loop() -> float:
        with tempfile.TemporaryDirectory(prefix="saving-", dir=options.folder) as folder:
            return in_fresh_process(plain, Path(folder), options.tasks * ROUNDS, size)

    def driver(threads: int) -> SavingMeasurement:
        with tempfile.TemporaryDirectory(prefix="saving-", dir=options.folder) as folder:
            return in_fresh_process(drive, Path(folder), options.tasks, size, threads)

    def work() -> report.Report:
        loops, measured = [loop()], []
        for threads in options.writers:
            measured.append(driver(threads))
            loops.append(loop())
        return _report(options.tasks, size, loops, measured)

    return report.run("saving", options, work)


def _report(
    tasks: int, size: int, loops: Sequence[float], measured: Sequence[SavingMeasurement]
) -> report.Report:
    """The measurements next to the loops before and after each."""
    rows: list[tuple[object, ...]] = []
    good = True
    for number, one in enumerate(measured):
        disk = (loops[number] + loops[number + 1]) / 2
        share = one.rate / disk
        rows.append((one.writers, one.rate, disk, share, one.most, one.memory))
        good = good and one.most <= one.writers and (one.writers != writers.LARGE or share >= _LEAST)
    head = ("writers", "MB/s", "plain loop, MB/s", "share", "most in memory", "growth of peak, messages")
    title = (
        f"{tasks} tasks, {ROUNDS} checkpoints of {size / 1e6:.0f} MB each; {writers.LARGE} writers by default"
    )
    content = {"tasks": tasks, "bytes": size, "loops": loops, "measured": [asdict(one) for one in measured]}
    return report.Report(content, f"{title}\n\n{report.markdown(head, rows)}", passed=good)


if __name__ == "__main__":
    sys.exit(main())
