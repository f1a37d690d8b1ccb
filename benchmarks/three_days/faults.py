"""What goes wrong in a simulated run, and when: drawn once from a seed, so that each driver sees the same.

Rates are on the pessimistic side of what is published. Llama 3 had an unexpected interruption for each 50,000
GPU hours in a data centre (Grattafiori et al., The Llama 3 Herd of Models, 2024, table 5); rented and
office machines fail tens of times as often, and a run of three days must survive these.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.three_days.load import GPUS, HOUR, Load
from panolog.workers.tasks import StrEnum

GIB = 2**30
NOTICED = 40.0  # seconds from the loss of a machine until Ray gives it up
NEVER = float("inf")


class Fault(StrEnum):
    """What happens to one attempt, or to the run."""

    KILLED = "worker killed"
    HUNG = "task hung"
    EIO = "read error"
    MEMORY = "out of memory"
    BAD_NODE = "bad node"
    NODE_LOST = "node lost"
    DRIVER_KILLED = "driver killed"
    DRIVER_STOPPED = "driver stopped"
    DISK_FULL = "disk full"
    LOCKED = "database locked"


# Expected hours of a device between two faults of a kind.
RATES: dict[Fault, float] = {Fault.KILLED: 150.0, Fault.HUNG: 400.0, Fault.EIO: 300.0}
_FEW = 1000.0  # hours of all devices, below which faults are more frequent: a short run must have some too


@dataclass(frozen=True)
class Period:
    """From one second of the run to another."""

    begin: float
    end: float

    def has(self, time: float) -> bool:
        """Whether a time is in it."""
        return self.begin <= time < self.end


@dataclass(frozen=True)
class Host:
    """A machine: when it is up, each time as a new node of the cluster, and when it fails all tasks."""

    name: str
    gpu: str  # the product's name
    memory: int  # bytes of each GPU
    slowness: float  # seconds of a block, over those on the fastest kind
    up: tuple[Period, ...]
    bad: tuple[Period, ...] = ()

    def node(self, time: float) -> int | None:
        """The number of the node that Ray lists, which it does until it has noticed the loss."""
        for number, period in enumerate(self.up):
            if Period(period.begin, period.end + NOTICED).has(time):
                return number
        return None

    def missing(self, period: Period) -> float:
        """Seconds of a period in which it was down."""
        there = sum(max(0.0, min(p.end, period.end) - max(p.begin, period.begin)) for p in self.up)
        return period.end - period.begin - there


@dataclass(frozen=True)
class Plan:
    """All faults that are not drawn for an attempt. Times are seconds since the start of the run."""

    hosts: tuple[Host, ...]
    driver_ends: tuple[tuple[float, Fault], ...]
    disk_full: tuple[Period, ...]
    locked: tuple[Period, ...]
    small_cache: frozenset[int] = field(default_factory=frozenset)  # blocks that need a smaller image cache
    large_gpu: frozenset[int] = field(default_factory=frozenset)  # blocks that need more than the usual GPU

    @property
    def speed(self) -> float:
        """Of all GPUs together, the fastest kind having 1."""
        return sum(GPUS / host.slowness for host in self.hosts)


# When drivers end, as shares of the run.
_DRIVER_ENDS = (
    (0.20, Fault.DRIVER_KILLED),
    (0.23, Fault.DRIVER_KILLED),
    (0.40, Fault.DRIVER_STOPPED),
    (0.75, Fault.DRIVER_KILLED),
)
# Kinds of GPUs: name, GiB, slowness, share of the machines.
KINDS = (("RTX 4090", 24, 1.0, 0.6), ("RTX 3090", 24, 1.5, 0.3), ("RTX 5090", 32, 0.8, 0.1))


def draw(load: Load) -> Plan:
    """The faults of a run."""
    seed, machines, blocks, seconds = load.seed, load.machines, load.blocks, load.seconds
    random = np.random.default_rng([seed, 1])
    chosen = random.permutation(machines)
    losses = max(1, round(machines * seconds / (7 * 24 * HOUR)))  # each machine once a week
    lost = {int(host): random.uniform(0.1, 0.8) * seconds for host in chosen[:losses]}
    bad = chosen[losses : losses + max(1, machines // 10)]  # a tenth of the machines
    bad = bad[: 0 if Fault.BAD_NODE in load.without else None]
    fails = {int(host): random.uniform(0.05, 0.5) * seconds for host in bad}
    odd = random.permutation(blocks)
    few = max(1, blocks // 100)
    return Plan(
        hosts=tuple(_host(i, machines, seconds, lost.get(i), fails.get(i)) for i in range(machines)),
        driver_ends=tuple(
            (share * seconds, fault) for share, fault in _DRIVER_ENDS if fault.value not in load.without
        ),
        disk_full=_periods(load, Fault.DISK_FULL, (0.31, 0.62), 1200),
        locked=_periods(load, Fault.LOCKED, (0.12, 0.55), 90),
        small_cache=frozenset(odd[:few].tolist()),
        large_gpu=frozenset(odd[few : few + max(1, few // 3)].tolist()),
    )


def _periods(load: Load, fault: Fault, shares: Sequence[float], seconds: float) -> tuple[Period, ...]:
    """Of so many seconds each, at those shares of the run."""
    begins = (share * load.seconds for share in shares if fault.value not in load.without)
    return tuple(Period(begin, begin + seconds) for begin in begins)


def _host(number: int, machines: int, seconds: float, lost: float | None, bad: float | None) -> Host:
    shares = np.cumsum([share for *_, share in KINDS]) - 1e-9
    kind = int(np.searchsorted(shares, (number + 0.5) / machines))
    name, memory, slowness, _ = KINDS[kind]
    up: tuple[Period, ...] = (Period(0.0, NEVER),)
    if lost is not None:
        up = (Period(0.0, lost), Period(lost + 0.01 * seconds, NEVER))  # back after 43 minutes of three days
    periods = () if bad is None else (Period(bad, bad + 0.15 * seconds),)  # for 11 hours of three days
    return Host(f"machine-{number:02d}", name, memory * GIB, slowness, up, periods)


def first_fault(load: Load, random: np.random.Generator) -> tuple[float, Fault]:
    """The first fault of an attempt by chance: seconds after its start."""
    faster = min(1.0, GPUS * load.machines * load.hours / _FEW)
    drawn = [(float(random.exponential(hours * faster * HOUR)), kind) for kind, hours in RATES.items()]
    return min((pair for pair in drawn if pair[1] not in load.without), default=(NEVER, Fault.KILLED))
