"""The figures of a simulated run, and the bounds that they must keep, each with its reason."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

from benchmarks import report
from benchmarks.three_days.checks import Life, Sent
from benchmarks.three_days.faults import Fault, Period, Plan
from benchmarks.three_days.life import Sample
from benchmarks.three_days.load import GPUS, HOUR, Load
from panolog.orchestrator.run import thinning
from panolog.orchestrator.run.records import Merged, NodeQuarantined, NodeReleased, PlanSaved, Stored

MEGA = 1e6
_FILE = 4096  # bytes that a small one takes
_ENDS = ("Ended", "Failed", "cancelled")
_FAULT_OF = {  # by the beginning of a failure's reason
    "the worker process died": Fault.KILLED,
    "the worker's machine died": Fault.NODE_LOST,
    "out of memory": Fault.MEMORY,
    "OSError": Fault.EIO,
    "RuntimeError": Fault.BAD_NODE,
}


@dataclass(frozen=True)
class Bound:
    """One figure with its limit."""

    name: str
    measured: float
    limit: float
    reason: str
    timed: bool = False  # depends on the speed of the machine: tests leave it to the benchmark

    @property
    def holds(self) -> bool:
        """Whether it is within the limit."""
        return self.measured <= self.limit


@dataclass(frozen=True)
class FullRate:
    """The driver with a message a second from each task."""

    hours: float  # simulated
    messages: int
    cpu: float  # seconds of the driver
    rows: int  # of progress in the database
    database: int  # bytes at the end

    @property
    def bound(self) -> Bound:
        """On the cost of a message."""
        reason = "80 tasks with a message a second then take 4 % of a core; SQLite takes most of it"
        return Bound("driver CPU of a message, µs", self.cpu / self.messages * MEGA, 500, reason, timed=True)

    @property
    def sentence(self) -> str:
        """For people."""
        return (
            f"With a message a second from each task: {self.messages:,} messages in {self.hours:.1f}"
            f" simulated hours took {self.cpu:.0f} s of CPU and left {self.rows:,} rows of progress,"
            f" {self.database / MEGA:.0f} MB of run.db."
        )


@dataclass(frozen=True)
class Makespan:
    """Stage II, from the plan to the merge. Hours; of devices where it says so."""

    hours: float
    busy: float  # of devices: attempts, from their start to their end
    useful: float  # of them: what an undisturbed run on the same devices would have needed
    missing: float  # of devices: machines that were down or in quarantine
    away: float  # without a driver
    longest: float  # the longest block, on the slowest GPU
    devices: int

    @property
    def bound(self) -> float:
        """Hours that list scheduling needs at most for work and absences like these (Graham, 1966)."""
        return (self.busy + self.missing) / self.devices + self.away + self.longest

    @property
    def least(self) -> float:
        """Hours that any schedule needs: no device is ever idle."""
        return (self.busy + self.missing) / self.devices + self.away


def makespan(
    load: Load, plan: Plan, sent: Sequence[Sent], records: Sequence[Stored], lives: Sequence[Life]
) -> Makespan:
    """That of a finished run."""
    epoch = records[0].time
    begin = next(item.time for item in records if isinstance(item.record, PlanSaved)) - epoch
    end = next(item.time for item in records if isinstance(item.record, Merged)) - epoch
    seconds = load.block_seconds(plan.speed)
    slowest = max(host.slowness for host in plan.hosts)
    whole = Period(begin, end)
    missing = sum(host.missing(whole) for host in plan.hosts)
    missing += sum(_quarantined(records, epoch, whole))
    gaps = [b.begin - a.end for a, b in pairwise(lives) if whole.has(a.end)]
    return Makespan(
        hours=(end - begin) / HOUR,
        busy=sum(_busy(sent, lives)) / HOUR,
        useful=sum(seconds) / plan.speed * GPUS * len(plan.hosts) / HOUR,
        missing=GPUS * missing / HOUR,
        away=sum(gaps) / HOUR,
        longest=max(seconds) * slowest / HOUR,
        devices=GPUS * len(plan.hosts),
    )


def _quarantined(records: Sequence[Stored], epoch: float, whole: Period) -> Iterator[float]:
    """Seconds of each quarantine of a node within a period."""
    begun: dict[str, float] = {}
    for item in records:
        time = item.time - epoch
        if isinstance(item.record, NodeQuarantined):
            begun[item.record.node] = time
        elif isinstance(item.record, NodeReleased) and item.record.node in begun:
            yield max(0.0, min(time, whole.end) - max(begun.pop(item.record.node), whole.begin))
    yield from (max(0.0, whole.end - max(begin, whole.begin)) for begin in begun.values())


def _busy(sent: Sequence[Sent], lives: Sequence[Life]) -> Iterator[float]:
    """Seconds of each attempt at a block. Those that run die with their driver."""
    started: dict[str, float] = {}
    ends = [life.end for life in lives]
    for line in sent:
        while line.time > ends[0]:
            over = ends.pop(0)
            yield from (over - since for since in started.values())
            started.clear()
        if line.task.index is None or not line.task.stage.trains:
            continue
        if line.kind == "start":
            started[str(line.task)] = line.time
        elif line.kind in _ENDS:
            yield line.time - started.pop(str(line.task))


def met(sent: Sequence[Sent], plan: Plan, lives: Sequence[Life]) -> dict[str, int]:
    """How often each fault struck."""
    kinds = Counter[str]()
    for line in sent:
        if line.kind == "Failed":
            kinds[next(f.value for start, f in _FAULT_OF.items() if line.detail.startswith(start))] += 1
        elif line.kind == "cancelled":
            kinds[Fault.HUNG.value] += 1
    kinds[Fault.DRIVER_KILLED.value] = sum(life.killed for life in lives)
    kinds[Fault.DRIVER_STOPPED.value] = len(lives) - 1 - kinds[Fault.DRIVER_KILLED.value]
    kinds[Fault.DISK_FULL.value], kinds[Fault.LOCKED.value] = len(plan.disk_full), len(plan.locked)
    return {fault.value: kinds[fault.value] for fault in Fault}


def bounds(load: Load, samples: Sequence[Sample], span: Makespan) -> list[Bound]:
    """All bounds."""
    drivers = [list(group) for _, group in groupby(samples, key=lambda sample: sample.driver)]
    return [
        Bound(
            "driver memory, peak MB",
            max(sample.memory for sample in samples) / MEGA,
            450,
            "torch and the simulation take 320 MB; state and plan of 1,000 blocks some tens",
        ),
        Bound(
            "driver memory, growth of one driver after its first hour, MB",
            max(_growth([s.memory for s in driver if s.hours > driver[0].hours + 1]) for driver in drivers)
            / MEGA,
            40,
            "state grows by 10 kB with each block; nothing may stay of a message",
        ),
        Bound(
            "descriptors, most",
            max(sample.descriptors for sample in samples),
            64,
            "files are open while they are written; a leak for each attempt would show as thousands",
        ),
        Bound(
            "run.db, MB",
            samples[-1].database / MEGA,
            1.2 * load.blocks * thinning.most_stored(span.longest * HOUR) * thinning.ROW / MEGA,
            "of each task the rows that thinning keeps in the time of the longest; a fifth for the rest",
        ),
        Bound(
            "other files, MB",
            max((s.disk - s.database) / MEGA for s in samples if s.disk is not None),
            load.blocks * (thinning.PREVIEWS + 4) * _FILE / MEGA + 20,
            "of each block 16 previews, a model, a checkpoint and the next one; plan and merged model",
        ),
        Bound(
            "driver CPU, seconds per simulated hour",
            max(driver[-1].cpu / max(1.0, driver[-1].hours - driver[0].hours) for driver in drivers),
            20,
            "half a percent of one core",
            timed=True,
        ),
        Bound(
            "makespan, hours",
            span.hours,
            span.bound,
            "list scheduling: work, also what was redone, and absences over devices, and the longest block",
        ),
    ]


def _growth(values: Sequence[int]) -> int:
    """From the first value to the largest."""
    return max(values) - values[0] if values else 0


def table(span: Makespan, checked: Sequence[Bound], faults: dict[str, int]) -> str:
    """Bounds, faults and the makespan, in Markdown."""
    rows = [(b.name, b.measured, f"≤ {b.limit:g}", "yes" if b.holds else "NO", b.reason) for b in checked]
    days = [
        ("Stage II", span.hours),
        ("no schedule is shorter: work and absences over devices", span.least),
        ("without any fault, all devices busy", span.useful / span.devices),
        ("work that was redone or hung, device hours", span.busy - span.useful),
        ("machines away or in quarantine, device hours", span.missing),
        ("without a driver", span.away),
    ]
    return "\n\n".join(
        [
            report.markdown(("what", "measured", "bound", "met", "reason"), rows),
            report.markdown(("fault", "times"), list(faults.items())),
            report.markdown(("Stage II", "hours"), days),
        ]
    )
