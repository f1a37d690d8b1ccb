"""The machines that a driver has requested from an autoscaler, and which it should request next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from panolog.orchestrator.engine.scheduling.placement import Running
from panolog.orchestrator.engine.scheduling.scaling import STARTUP_S, Growth, Price, Scaling, Work, coming
from panolog.orchestrator.runs.clock import Clock
from panolog.orchestrator.runs.machines.config import ScalingConfig
from panolog.orchestrator.runs.machines.nodes import Node

_USUAL = 2  # measured starts that the usual one counts as
_DRY_S = 1800.0  # for which a group that has given no machine comes last


@dataclass(frozen=True)
class Coming:
    """A decision."""

    wanted: Mapping[str, int] = field(default_factory=dict)  # more than there are, by group
    more: Mapping[str, int] = field(default_factory=dict)  # of these, those that are new
    nodes: tuple[Node, ...] = ()  # that are coming
    fill: tuple[Running, ...] = ()  # what keeps tasks from these until then


class Expected:
    """The machines that were requested and are not there yet, and how long those took that are."""

    def __init__(self, clock: Clock, joined: float | None = None) -> None:
        """Args: joined, seconds in which a machine came that was requested before, if one was."""
        self._clock = clock
        self.since: dict[str, list[float]] = {}  # Clock.time() of the requests, by group, the earliest first
        self.known: dict[str, Node] = {}  # the last machine of each group
        self._present: dict[str, int] = {}
        self._dry: dict[str, float] = {}  # Clock.time() at which a group had given none for too long
        self._startups = [] if joined is None else [joined]  # seconds

    @property
    def startup(self) -> float:
        """Seconds from a request to its machine: what is usual at first, then more and more as measured."""
        return (_USUAL * STARTUP_S + sum(self._startups)) / (_USUAL + len(self._startups))

    def decide(
        self,
        growth: Growth,
        work: Work,
        running: Sequence[Running],
        nodes: Sequence[Node],
        settings: ScalingConfig,
        price: Price,
        *,
        cuda: bool,
    ) -> Coming:
        """Which machines should be requested now, and which are coming. Args: as `Scaling.wanted`."""
        self._review(growth, nodes)
        scaling = Scaling(growth, cuda, settings.overhead, self.startup, self.known, price)
        late = self._note_late(settings.patience)
        wanted = scaling.wanted(work, running, nodes, late)
        more = self._change(wanted)
        groups, now = {group.name: group for group in growth.groups}, self._clock.time()
        found = [
            (scaling.node(groups[name], number), max(0.0, time + self.startup - now))
            for name, times in self.since.items()
            if name not in late
            for number, time in enumerate(times)
        ]
        return Coming(wanted, more, tuple(node for node, _ in found), tuple(coming(found, cuda=cuda)))

    def _review(self, growth: Growth, nodes: Sequence[Node]) -> None:
        """Takes note of which have come. Args: nodes that can be used."""
        self.known |= growth.described(nodes)
        for group in growth.groups:
            present = growth.present(group)
            for _ in range(present - self._present.get(group.name, present)):
                self._dry.pop(group.name, None)
                if times := self.since.get(group.name):
                    self._startups.append(self._clock.time() - times.pop(0))
            self._present[group.name] = present
        self.since = {name: times for name, times in self.since.items() if times}

    def _change(self, wanted: Mapping[str, int]) -> dict[str, int]:
        """Requests so many by group, and no others. Returns how many more than before."""
        more = {name: count - len(self.since.get(name, ())) for name, count in wanted.items()}
        new = {name: [self._clock.time()] * count for name, count in more.items()}
        self.since = {name: [*self.since.get(name, ()), *new[name]][:count] for name, count in wanted.items()}
        return {name: count for name, count in more.items() if count > 0}

    def _note_late(self, seconds: float) -> set[str]:
        """The groups that have given no machine for so long, now or a while ago."""
        now = self._clock.time()
        late = [name for name, times in self.since.items() if now - times[0] > seconds]
        self._dry |= {name: now for name in late if name not in self._dry}
        self._dry = {name: at for name, at in self._dry.items() if name in late or now - at < _DRY_S}
        return set(self._dry)
