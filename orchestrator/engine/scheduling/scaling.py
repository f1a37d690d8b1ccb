"""How many machines the tasks at hand should have, where an autoscaler can start some: pure decisions.

A machine costs from its start to its end. Each that joins also costs the time in which it starts, and that
for which it idles at its end, until the autoscaler removes it. So a stage gets as many as shorten it, but no
more than waste the part of its work that the settings allow (`scaling.overhead`), and at least one.
"""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

from panolog.orchestrator.engine.scheduling import placement
from panolog.orchestrator.engine.scheduling.placement import Demand, Running
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.orchestrator.runs.units import gib

STARTUP_S = 180.0  # in which a machine joins, until some have: clouds take one to five minutes
IDLE_S = 60.0  # after which the autoscaler removes an idle machine, as in the files of deploy/
_SAME = 1.02  # times the shortest time that is possible: fewer machines are better then
_ABUNDANT = 2**50  # bytes of the memory of a machine that does not say

# GiB that are free on a GPU, by the name that Ray has for it; from its makers' product pages, less a few
# per cent. A machine that has joined says it itself.
_GPU_MEMORY = {
    **{"T4": 14, "V100": 15, "A10G": 22, "L4": 22, "L40S": 44, "RTX-PRO-6000": 94, "H20": 94},
    **{"A100": 39, "A100-40G": 39, "A100-80G": 79, "H100": 79, "H200": 139, "B200": 178, "B300": 268},
}


@dataclass(frozen=True)
class Group:
    """Machines of one kind that an autoscaler can start."""

    name: str
    most: int  # at once
    cpus: int
    gpus: int = 0
    accelerator: str = ""  # what Ray calls its GPUs
    memory: int = 0  # bytes; 0 = unknown
    instance: str = ""  # as `Node.instance`
    labels: tuple[tuple[str, str], ...] = ()  # as `Node.labels`
    pins: tuple[str, ...] = ()  # resources that only machines of such groups have

    def node(self, number: int, known: Node | None = None) -> Node:
        """A machine of it that is not there. Args: known, one of it that has described itself."""
        id = f"{self.name} {number}"
        if known is not None:
            return replace(known, id=id, host=id)
        gpu = Gpu(self.accelerator or "GPU", _GPU_MEMORY.get(self.accelerator, 0) * 2**30)
        memory = self.memory or _ABUNDANT
        return Node(id, id, self.cpus, memory, (gpu,) * self.gpus, self.instance, self.labels)

    def text(self) -> str:
        gpus = f", {self.gpus} {self.accelerator or 'GPU'}" if self.gpus else ""
        memory = f", {gib(self.memory)}" if self.memory else ""
        cores = "core" if self.cpus == 1 else "cores"
        return f"{self.name} ({self.cpus} {cores}{memory}{gpus})"


@dataclass(frozen=True)
class Growth:
    """What an autoscaler could do, and does."""

    groups: tuple[Group, ...] = ()
    members: Mapping[str, str] = field(default_factory=dict)  # the group of each machine, by Node.id
    joining: int = 0  # machines that are there, but have not described themselves yet
    trouble: str = ""  # why machines do not come, as the autoscaler says

    def present(self, group: Group) -> int:
        """How many machines of a group there are, whether they can be used or not."""
        return sum(name == group.name for name in self.members.values())

    def described(self, nodes: Sequence[Node]) -> dict[str, Node]:
        """The last machine of each group that is among some, by the name of the group."""
        return {self.members[node.id]: node for node in nodes if node.id in self.members}

    @property
    def report(self) -> str:
        """`trouble` as the end of a sentence; "" without any."""
        return f"; it reports: {self.trouble}" if self.trouble else ""


NO_GROWTH = Growth()
Price = Callable[[Node], float | None]  # per hour


@dataclass(frozen=True)
class Work:
    """The tasks of a stage that wait for a place."""

    demands: Sequence[Demand]
    seconds: Sequence[float]  # of each, expected
    whole: float | None = None  # seconds of all tasks of the stage, also those that run or are done

    def largest(self) -> Demand:
        """The demand that needs most memory."""
        return max(self.demands, key=lambda demand: demand.memory)


@dataclass(frozen=True)
class Scaling:
    """What an autoscaler can start, and what is known of it."""

    growth: Growth
    cuda: bool
    overhead: float  # of the work of a stage that machines may cost besides, see `ScalingConfig`
    startup: float = STARTUP_S  # seconds in which a machine joins
    known: Mapping[str, Node] = field(default_factory=dict)  # a machine of each group that was seen
    price: Price = lambda _: None

    def node(self, group: Group, number: int = 0) -> Node:
        """A machine of a group that is not there."""
        return group.node(number, self.known.get(group.name))

    def preferred(self, need: int) -> list[Group]:
        """The groups for a task, best first: those that fit, by price, else by size; or the largest.

        Args: need, bytes of memory.
        """
        able = [g for g in self.growth.groups if g.most and placement.able([self.node(g)], cuda=self.cuda)]
        sizes = {g.name: placement.largest([self.node(g)], cuda=self.cuda) for g in able}
        fitting = [g for g in able if not sizes[g.name] or sizes[g.name] >= need]
        if not fitting:
            most = max(sizes.values(), default=0)
            fitting = [g for g in able if sizes[g.name] == most]
        prices = {g.name: self.price(self.node(g)) for g in fitting}
        size = {g.name: (sizes[g.name] or _ABUNDANT, g.gpus, g.cpus) for g in fitting}
        return sorted(fitting, key=lambda g: (prices[g.name] is None, prices[g.name] or 0.0, size[g.name]))

    def wanted(
        self, work: Work, running: Sequence[Running], nodes: Sequence[Node], without: Set[str] = frozenset()
    ) -> dict[str, int]:
        """How many more machines there should be than now, by group; those that start already count.

        Args: nodes that can be used; running, what runs there; without, groups that give no more for now.
        """
        if not work.demands:
            return {}
        groups = self.preferred(work.largest().memory)
        groups = [g for g in groups if g.name not in without] or groups
        room = {g.name: max(0, g.most - self.growth.present(g)) for g in groups}
        if not any(room.values()):
            return {}
        there = placement.free_times(work.demands, nodes, running, cuda=self.cuda)
        new = placement.free_times(work.demands, [self.node(groups[0])], (), cuda=self.cuda)
        there += new * self.growth.joining
        have = len(placement.able(nodes, cuda=self.cuda)) + self.growth.joining
        most = min(sum(room.values()), self.affordable(work.whole) - have, len(work.demands))
        least = 0 if there and (self.growth.joining or self._fits(work, nodes)) else 1
        count = _fewest(work.seconds, there, [time + self.startup for time in new], least, max(least, most))
        found = dict[str, int]()
        for group in groups:
            if taken := min(count - sum(found.values()), room[group.name]):
                found[group.name] = taken
        return found

    def affordable(self, whole: float | None) -> int:
        """How many machines may work on a stage. Args: whole, as `Work`."""
        if whole is None:
            return sum(group.most for group in self.growth.groups)
        return max(1, int(self.overhead * whole / (self.startup + IDLE_S)))

    def potential(self, need: int, whole: float | None, nodes: Sequence[Node]) -> list[Node]:
        """The machines that a stage could have: those that are there, and more as far as they are affordable.

        Args: need, bytes of memory of a task; whole, as `Work`.
        """
        found = list(nodes)
        for group in self.preferred(need):
            room = group.most - self.growth.present(group)
            count = min(room, self.affordable(whole) - len(found))
            found += [self.node(group, number) for number in range(count)]
        return found

    def _fits(self, work: Work, nodes: Sequence[Node]) -> bool:
        """Whether each task has a machine with enough memory."""
        most = placement.largest(nodes, cuda=self.cuda)
        return not most or work.largest().memory <= most


def coming(machines: Iterable[tuple[Node, float]], *, cuda: bool) -> list[Running]:
    """What fills machines that are not there yet, so that nothing is placed on them.

    Args: machines, with the seconds after which each is expected.
    """
    found = []
    for node, seconds in machines:
        if not cuda:
            found.append(Running(Placement(node.id, float(node.cpus), 0), seconds))
        for number in range(len(node.gpus) if cuda else 0):
            found.append(Running(Placement(node.id, 0.0, 0, 1.0, number), seconds))
    return found


def _fewest(seconds: Sequence[float], there: list[float], new: list[float], least: int, most: int) -> int:
    """How many machines end the tasks as soon as `most` do, or hardly later.

    Args: there, when each place is free, in seconds; new, when those of one more machine are.
    """
    longest_first = sorted(seconds, reverse=True)

    def end(count: int) -> float:
        return _makespan(longest_first, [*there, *(new * count)])

    best = end(most)
    return least + bisect_left(range(least, most), True, key=lambda count: end(count) <= _SAME * best)


def _makespan(longest_first: Sequence[float], places: list[float]) -> float:
    """When the last task ends, each on the place that is free first; inf without a place."""
    if not places:
        return float("inf")
    free, last = list(places), 0.0
    heapq.heapify(free)
    for seconds in longest_first:
        end = free[0] + seconds
        heapq.heapreplace(free, end)
        last = max(last, end)
    return last
