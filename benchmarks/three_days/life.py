"""The life of one driver in a process of its own: from its start until it is killed, stopped or done.

A module of its own: a fresh process imports the module of its function, which cannot be a `__main__`.
"""

import errno
import json
import os
import signal
import socket
import sqlite3
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from unittest.mock import patch

from benchmarks.processes import resident_memory
from benchmarks.three_days import faults
from benchmarks.three_days.cluster import SimulatedCluster, VirtualClock
from benchmarks.three_days.faults import Fault, Period
from benchmarks.three_days.load import HOUR, Load
from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.driver.requests import Stop
from panolog.orchestrator.resources.pool import Hello, Message
from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.run.records import ModelSaved, RunBegan, Stored
from panolog.orchestrator.run.state import RunState, Status
from panolog.orchestrator.run.store import Database
from panolog.orchestrator.stages.scenes import scene_of
from panolog.scene.files import remove_partial

SAMPLE_S = 600.0  # simulated seconds between two samples
DISK_S = 7200.0  # between two measurements of the run folder: it takes 0.1 s with 60,000 files
STOPPED = 130


class _Spot(Enum):
    """Where in its work a SIGKILL that is due strikes a driver: each time at another."""

    WRITING = 0  # while a file is written: of the messages since the last record some are on the disk
    TAKEN = 1  # a worker's first message was taken, and is not recorded
    RECORDED = 2  # a model was recorded, and its checkpoint is not removed


@dataclass(frozen=True)
class Paths:
    """Files of the simulation, outside of the run folder."""

    root: Path

    @property
    def run(self) -> RunFolder:
        """The run."""
        return RunFolder(self.root / "run")

    @property
    def log(self) -> Path:
        """What workers have sent, one line each."""
        return self.root / "sent.tsv"

    @property
    def samples(self) -> Path:
        """Samples, one JSON object per line."""
        return self.root / "samples.jsonl"


@dataclass(frozen=True)
class Sample:
    """A driver at one moment; sizes in bytes."""

    hours: float  # simulated, since the start of the run
    driver: int  # 0 for the first
    memory: int  # resident, with the simulation's
    descriptors: int
    database: int
    cpu: float  # seconds of this driver so far, without the simulation's
    simulation: float  # seconds of the simulation
    messages: int  # that this driver has taken
    running: int  # tasks
    nodes: int
    quarantined: int
    done: int  # blocks
    disk: int | None = None  # of the run folder; None if it was not measured


def read_samples(paths: Paths) -> list[Sample]:
    """All samples, in order."""
    return [Sample(**json.loads(line)) for line in paths.samples.read_text().splitlines()]


def live(paths: Paths, load: Load, epoch: float, now: float, number: int) -> None:
    """Drives the run until a fault ends this driver, with exit code 130 for a stop, or to its end.

    Args: epoch, the start of the run in seconds since 1970; now, seconds since then; number of the driver, 0
    for the first. Raises what the driver raises.
    """
    plan = faults.draw(load)
    folder, clock = paths.run, VirtualClock(epoch, now)
    info = read_info(folder)
    remove_partial(folder.root)
    with ExitStack() as stack:
        stack.enter_context(lock.hold(folder.lock))
        database = stack.enter_context(closing(Database(folder.database, clock)))
        world = _World(paths, plan, clock, number)
        cluster = SimulatedCluster(clock, load, plan, paths.log)
        world.cluster = cluster
        stack.enter_context(patch("os.fsync", world.fsync))
        world.journal = journal = Journal(database, clock=clock)
        began = RunBegan(socket.gethostname(), os.getpid(), number > 0, journal.state.latest)
        journal.record([began, *control.begin(folder)])
        world.sample(disk=True)
        clock.on_tick, cluster.on_message = world.on_tick, world.on_message
        journal.on_change = world.on_change
        try:
            Driver(Job(folder, scene_of(info, folder), info.config), journal, cluster, stop=Stop()).run()
        except KeyboardInterrupt:
            raise SystemExit(STOPPED) from None
        finally:
            world.sample(disk=True)


class _World:
    """What happens around a driver as the clock runs: faults of the run as a whole, and samples of it."""

    cluster: SimulatedCluster
    journal: Journal

    def __init__(self, paths: Paths, plan: faults.Plan, clock: VirtualClock, number: int) -> None:
        self._paths, self._plan, self._clock = paths, plan, clock
        self._ends = [end for end in plan.driver_ends if end[0] > clock.now]
        kills = [fault for _, fault in plan.driver_ends if fault == Fault.DRIVER_KILLED]
        left = [fault for _, fault in self._ends if fault == Fault.DRIVER_KILLED]
        self._spot = _Spot((len(kills) - len(left)) % len(_Spot))  # of the next kill
        self._doomed = False  # a kill is due
        self._sampled = self._measured = clock.now
        self._number = number
        self._holder: sqlite3.Connection | None = None
        self._cpu = 0.0  # seconds used by this object
        self._real = os.fsync

    def on_tick(self) -> None:
        """After each jump of the clock."""
        began, now = time.thread_time(), self._clock.now
        if self._ends and now >= self._ends[0][0]:
            self._end(self._ends.pop(0)[1])
        self._hold(_within(self._plan.locked, now))
        if now - self._sampled >= SAMPLE_S:
            self.sample(disk=now - self._measured >= DISK_S)
        self._cpu += time.thread_time() - began

    def on_message(self, message: Message) -> None:
        """After a message was taken and logged."""
        if isinstance(message, Hello):
            self._at(_Spot.TAKEN)

    def on_change(self, _: RunState, stored: Sequence[Stored]) -> None:
        """After records were stored, and often without one."""
        if any(isinstance(item.record, ModelSaved) for item in stored):
            self._at(_Spot.RECORDED)

    def fsync(self, descriptor: int) -> None:
        """`os.fsync` on a disk that is full at times."""
        self._at(_Spot.WRITING)
        if _within(self._plan.disk_full, self._clock.now):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._real(descriptor)

    def sample(self, *, disk: bool) -> None:
        """Appends a sample. Args: disk, also the size of the run folder."""
        self._sampled = self._clock.now
        self._measured = self._clock.now if disk else self._measured
        state = self.journal.state
        sample = Sample(
            hours=self._clock.now / HOUR,
            driver=self._number,
            memory=resident_memory(),
            descriptors=sum(1 for _ in Path("/proc/self/fd").iterdir()),
            database=self._paths.run.database.stat().st_size,
            cpu=time.process_time() - self.cluster.cpu - self._cpu,
            simulation=self.cluster.cpu + self._cpu,
            messages=self.cluster.messages,
            running=self.cluster.running,
            nodes=len(self.cluster.nodes()),
            quarantined=len(state.quarantined()),
            done=sum(
                task.status == Status.DONE for task in state.tasks.values() if task.id.index is not None
            ),
            disk=_disk(self._paths.run.root) if disk else None,
        )
        with self._paths.samples.open("a") as file:
            file.write(json.dumps(asdict(sample)) + "\n")

    def _end(self, fault: Fault) -> None:
        if fault == Fault.DRIVER_STOPPED:
            control.send(self._paths.run, "stop")
        else:
            self._doomed = True

    def _at(self, spot: _Spot) -> None:
        """The driver is there."""
        if self._doomed and spot == self._spot:
            os.kill(os.getpid(), signal.SIGKILL)

    def _hold(self, locked: bool) -> None:
        """Another program takes the lock of the database, or gives it back."""
        if locked and self._holder is None:
            self._holder = sqlite3.connect(self._paths.run.database, isolation_level=None)
            self._holder.execute("BEGIN EXCLUSIVE")
        elif not locked and self._holder is not None:
            self._holder.close()
            self._holder = None


def _within(periods: tuple[Period, ...], now: float) -> bool:
    return any(period.has(now) for period in periods)


def _disk(folder: str | Path) -> int:
    """Bytes on the disk below a folder."""
    with os.scandir(folder) as entries:
        found = list(entries)
    here = sum(entry.stat().st_blocks for entry in found if entry.is_file()) * 512
    return here + sum(_disk(entry.path) for entry in found if entry.is_dir())
