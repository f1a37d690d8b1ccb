"""The machines that a driver has requested from an autoscaler, and which it should request next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from panolog.orchestrator.engine.scheduling.placement import Running
from panolog.orchestrator.engine.scheduling.scaling import STARTUP_S, Growth, Price, Scaling, Work, coming
from panolog.orchestrator.runs.clock import Clock
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

    def scaling(
        self,
        growth: Growth,
        nodes: Sequence[Node],
        overhead: float,
        price: Price,
        *,
        cuda: bool,
    ) -> Scaling:
        """What an autoscaler can start, with what is known by now. Args: nodes that can be used."""
        self._review(growth, nodes)
        return Scaling(growth, cuda, overhead, self.startup, self.known, price)

    def decide(
        self,
        scaling: Scaling,
        work: Work,
        running: Sequence[Running],
        nodes: Sequence[Node],
        patience: float,
    ) -> Coming:
        """Which machines should be requested now, and which are coming.

        Args: as `Scaling.wanted`; patience, seconds after which those of a group that has given none count no
        more.
        """
        late = self._note_late(patience)
        wanted = scaling.wanted(work, running, nodes, late)
        more = self._change(wanted)
        groups = {group.name: group for group in scaling.growth.groups}
        found = [
            (scaling.node(groups[name], number), seconds)
            for name, times in self._left().items()
            if name not in late
            for number, seconds in enumerate(times)
        ]
        fill = coming(found, cuda=scaling.cuda)
        return Coming(wanted, more, tuple(node for node, _ in found), tuple(fill))

    @property
    def first(self) -> float:
        """When the earliest of the requests was made, in seconds since the epoch."""
        return min(times[0] for times in self.since.values())

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

    def _left(self) -> dict[str, list[float]]:
        """Seconds until each should come, by group."""
        now, startup = self._clock.time(), self.startup
        return {name: [max(0.0, t + startup - now) for t in times] for name, times in self.since.items()}
