"""The faults that the benchmark knows: what each does to a run, for how long, and what it may cost."""

import errno
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random

import psutil
from typing_extensions import assert_never

from benchmarks.chaos.cluster import GROUPS, HEAD, SECOND, LocalCluster
from benchmarks.chaos.shim import READ, WRITE, Rule
from panolog.orchestrator.runs.folder import RunFolder
from panolog.workers.tasks import StrEnum

SILENCE_S = 30.0  # deadlines.message; a worker reports every second
HELLO_S = 120.0  # deadlines.hello, in which a worker starts also on a busy machine
RETRY_S = 1.0  # disk.retry
QUARANTINE = 3  # quarantine.failures
DAY_S = 86_400  # by which a clock jumps
_DELAY_S = 0.05  # of each slow call: a commit to run.db makes twenty
_START_S = 10.0  # in which a failure is noticed and a task has started again
_SUPERVISOR_S = 2.0  # before it resumes
_HEAD_S = 25.0  # in which a lost head is noticed and started again
_ANEW_S = 30.0  # in which a task without a checkpoint comes as far again as it was
# Holds the lock of a database until its stdin ends.
_LOCKER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None, timeout=60)
connection.execute("BEGIN EXCLUSIVE")
print("locked", flush=True)
sys.stdin.read()
"""
Undo = Callable[[], object]


class Kind(StrEnum):
    """What goes wrong."""

    DRIVER = "driver"  # SIGKILL
    WORKER = "worker"  # SIGKILL for a busy one
    RAYLET = "raylet"  # SIGKILL, and a new node
    HANG = "hang"  # SIGSTOP of a busy worker, for good
    PAUSE = "pause"  # SIGSTOP of a raylet for less or for more than Ray waits for it
    BADNODE = "badnode"  # all reads of panoramas on the second node fail until the run ends
    EIO = "eio"  # one read of a panorama fails in one worker, with EIO or ESTALE
    ENOSPC = "enospc"  # the disk of the run is full
    SLOW = "slow"  # each read and write of scene and run takes longer
    LOCKED = "locked"  # another process locks run.db
    GCS = "gcs"  # SIGKILL for the head's record of the cluster, and a new head
    CLOCK = "clock"  # the wall clock of driver and workers jumps
    TERMINAL = "terminal"  # SIGKILL for what reads the output of supervisor and driver
    DAMAGE = "damage"  # the checkpoint of a busy worker is overwritten in part, and the worker killed
    VANISH = "vanish"  # the run folder is elsewhere for a while, as where a disk is unmounted
    MIRROR = "mirror"  # SIGKILL for what copies the run into its store
    STORE = "store"  # each read and write of the store takes longer


@dataclass(frozen=True)
class Limits:
    """How long a fault takes, and what it may cost besides that."""

    costs: float  # seconds
    lasts: tuple[float, ...] = (0.0,)  # seconds, one of these; 0 = nothing ends it before the run


LIMITS = {
    Kind.DRIVER: Limits(_SUPERVISOR_S + _START_S),
    Kind.WORKER: Limits(_START_S),
    Kind.RAYLET: Limits(_START_S),
    Kind.HANG: Limits(HELLO_S + _START_S),
    Kind.PAUSE: Limits(_START_S, (4.0, 13.0)),
    Kind.BADNODE: Limits(QUARANTINE * _START_S),
    Kind.EIO: Limits(_START_S),
    Kind.ENOSPC: Limits(RETRY_S + _START_S, (3.0, 6.0)),
    Kind.SLOW: Limits(_START_S, (4.0, 8.0)),
    Kind.LOCKED: Limits(RETRY_S + _START_S, (3.0, 8.0)),
    Kind.GCS: Limits(_HEAD_S + _SUPERVISOR_S + _START_S),
    Kind.CLOCK: Limits(_START_S),
    Kind.TERMINAL: Limits(_START_S),
    Kind.DAMAGE: Limits(_START_S + _ANEW_S),
    Kind.VANISH: Limits(RETRY_S + _START_S, (3.0, 6.0)),
    Kind.MIRROR: Limits(_START_S),
    Kind.STORE: Limits(_START_S, (4.0, 8.0)),
}


@dataclass(frozen=True)
class Planned:
    """A planned fault."""

    after: float  # seconds since the beginning of the run
    kind: Kind
    choice: float  # in [0, 1): which victim, and how long

    @property
    def lasts(self) -> float:
        """Seconds."""
        lasts = LIMITS[self.kind].lasts
        return lasts[int(self.choice * len(lasts))]

    @property
    def allowed(self) -> float:
        """Seconds that it may cost a run."""
        return LIMITS[self.kind].costs + self.lasts

    @property
    def what(self) -> str:
        """The kind and how long it takes, in words."""
        return f"{self.kind} {self.lasts:g} s" if self.lasts else str(self.kind)


def plans(runs: int, seed: int, seconds: float, kinds: Sequence[Kind]) -> Iterator[list[Planned]]:
    """For each run one or two faults, in order, within the time that an undisturbed run takes.

    All kinds are dealt before one comes again.
    """
    random = Random(seed)
    deck: list[Kind] = []
    for _ in range(runs):
        times = sorted(random.uniform(0.05, 0.95) * seconds for _ in range(random.randint(1, 2)))
        plan = []
        for after in times:
            deck = deck or random.sample(kinds, len(kinds))
            plan.append(Planned(after, deck.pop(), random.random()))
        yield plan


@dataclass(frozen=True)
class Victim:
    """A run at work."""

    cluster: LocalCluster
    scene: Path
    root: Path
    store: Path
    driver: psutil.Process | None  # not its supervisor; None between two
    mirror: psutil.Process | None
    terminal: subprocess.Popen[bytes]  # reads the output of both


def cause(planned: Planned, victim: Victim) -> Undo | None:
    """Makes it happen; returns what ends it. None if there is nothing to hit now."""
    cluster, choice = victim.cluster, planned.choice
    match planned.kind:
        case Kind.DRIVER | Kind.MIRROR | Kind.WORKER | Kind.RAYLET | Kind.HANG | Kind.PAUSE | Kind.GCS:
            return _signal(planned, victim)
        case Kind.BADNODE:
            return _fail(cluster, (SECOND,), Rule(victim.scene, READ, errno.EIO))
        case Kind.EIO:
            error = errno.EIO if choice < 1 / 2 else errno.ESTALE
            group = SECOND if int(choice * 4) % 2 else HEAD
            return _fail(cluster, (group,), Rule(victim.scene, READ, error, times=1))
        case Kind.ENOSPC:
            if not RunFolder(victim.root).presence.exists():
                return None  # on a full disk no run has to begin
            return _fail(cluster, GROUPS, Rule(victim.root, WRITE, errno.ENOSPC))
        case Kind.SLOW | Kind.STORE:
            slow = (victim.store,) if planned.kind == Kind.STORE else (victim.scene, victim.root)
            return _fail(cluster, GROUPS, *(Rule(it, READ | WRITE, delay=_DELAY_S) for it in slow))
        case Kind.LOCKED:
            return _lock(RunFolder(victim.root).database)
        case Kind.CLOCK:
            return _move_clocks(cluster, DAY_S if choice < 1 / 2 else -DAY_S)
        case Kind.TERMINAL:
            victim.terminal.kill()
            return nothing
        case Kind.DAMAGE:
            return _damage(planned, victim)
        case Kind.VANISH:
            return _move_away(victim.root)
        case _:
            assert_never(planned.kind)


def _signal(planned: Planned, victim: Victim) -> Undo | None:
    """Sends SIGSTOP to what hangs or pauses, SIGKILL to all else; the end is a SIGCONT."""
    kind, cluster = planned.kind, victim.cluster
    if kind in (Kind.DRIVER, Kind.MIRROR):
        process = victim.driver if kind == Kind.DRIVER else victim.mirror
    elif kind == Kind.GCS:  # without a head no run has to begin: that is refused
        process = cluster.gcs() if RunFolder(victim.root).preflight.exists() else None
    elif kind in (Kind.RAYLET, Kind.PAUSE):
        process = cluster.raylet()
    else:
        process = cluster.busy_worker(planned.choice)
    if process is None:
        return None
    try:
        process.send_signal(signal.SIGSTOP if kind in (Kind.HANG, Kind.PAUSE) else signal.SIGKILL)
    except psutil.NoSuchProcess:
        return None

    def undo() -> None:
        with suppress(psutil.NoSuchProcess):
            process.send_signal(signal.SIGCONT)

    return undo


def nothing() -> None:
    """What ends a fault that stays, or has ended."""


def _damage(planned: Planned, victim: Victim) -> Undo | None:
    """Overwrites the middle of each checkpoint that there is, and kills a worker."""
    found = list(victim.root.rglob("checkpoint.safetensors"))
    worker = victim.cluster.busy_worker(planned.choice) if found else None
    if worker is None:
        return None
    with suppress(psutil.NoSuchProcess):
        worker.suspend()  # so that it replaces none before it is dead
    for path in found:
        with suppress(FileNotFoundError), path.open("r+b") as file:
            file.seek(path.stat().st_size // 2)
            file.write(bytes(64))
    with suppress(psutil.NoSuchProcess):
        worker.kill()
    return nothing


def _move_away(root: Path) -> Undo | None:
    """Renames the folder of a run that has begun; the end is its old name."""
    if not RunFolder(root).presence.exists():
        return None
    away = root.with_name(f"{root.name}-away")
    root.rename(away)

    def undo() -> None:
        if not root.exists():
            away.rename(root)

    return undo


def _fail(cluster: LocalCluster, groups: Sequence[str], *rules: Rule) -> Undo:
    controls = [cluster.controls[group] for group in groups]
    made = [(control, control.add(rule)) for control in controls for rule in rules]

    def undo() -> None:
        for control, number in made:
            control.lift(number)

    return undo


def _lock(database: Path) -> Undo | None:
    """Another process locks a database that exists."""
    if not database.exists():
        return None
    command = [sys.executable, "-c", _LOCKER, str(database)]
    locker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert locker.stdout is not None
    locker.stdout.readline()
    return locker.communicate


def _move_clocks(cluster: LocalCluster, seconds: int) -> Undo:
    def move(offset: int) -> None:
        for control in cluster.controls.values():
            control.move_clock(offset)

    move(seconds)
    return lambda: move(0)
