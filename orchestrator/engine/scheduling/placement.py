"""Which waiting tasks start now, and where: pure decisions over what waits, what runs and what there is.

On GPUs (docs/decisions/0014-the-driver-chooses-gpus.md): each is cut into as many equal slots as tasks of the
size at hand fit into its memory, at most `_SHARED`, and no more than there are tasks for. Tasks are assigned
to these, also to busy ones, so that the last ends as soon as possible; of those assigned to a free slot the
longest starts. On CPUs: as many at once as there are cores and memory for, which share a node's free cores.

A task avoids the nodes and GPUs on which it has failed, as if it took `_PATIENCE_S` longer there for each
failure: it waits so long at most for others, and where it has failed on all it starts where it did so least.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush

import numpy as np

from panolog.orchestrator.engine.scheduling.longest_first import Floats, assign_lpt
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.workers.tasks import TaskId

_SHARED = 4  # tasks on one GPU at most: more would only wait for its cores
_PATIENCE_S = 600.0  # for which a task waits for another node than those on which it has failed
_EPSILON = 1e-6  # the parts of a GPU are rounded fractions
USABLE = 0.9  # of a node's free memory: the rest is for Ray and what the estimate leaves out

Placed = tuple[TaskId, Placement]


@dataclass(frozen=True)
class Demand:
    """A task that could start."""

    task: TaskId
    memory: int  # bytes that it needs, roughly: of a GPU, or of a node if it runs on the CPU
    seconds: Callable[[str], float] = lambda _: 1.0  # by kind of place
    alone: bool = False  # it has run out of memory: nothing else may run on its device
    more_than: int = 0  # bytes of memory that were not enough
    avoid: Mapping[str, float] = field(default_factory=dict)  # how often it has failed, by Node.id and card

    def avoids(self, device: "_Device") -> float:
        """How much it would rather start elsewhere, 0 = not at all."""
        card = "" if device.gpu is None else device.node.card(device.gpu)
        return self.avoid.get(device.node.id, 0.0) + self.avoid.get(card, 0.0)


@dataclass(frozen=True)
class Running:
    """A task that has its place."""

    placement: Placement
    left: float  # seconds that it still needs, roughly


@dataclass(frozen=True)
class _Device:
    """A GPU, or a node for tasks on the CPU, with those that run on it."""

    node: Node
    gpu: int | None
    memory: int  # bytes; 0 = unknown
    tasks: tuple[Running, ...]

    @property
    def card(self) -> Gpu:
        return self.node.gpus[self.gpu or 0]

    @property
    def free_in(self) -> float:
        """Seconds until it is empty."""
        return max((task.left for task in self.tasks), default=0.0)


def place(
    demands: Sequence[Demand], nodes: Sequence[Node], running: Iterable[Running], *, cuda: bool
) -> list[Placed]:
    """The tasks that start now, each with its placement.

    A task that must be alone is placed first, and where it has to wait for a device to become empty no other
    starts there. So is a task that seems to need more than any device has: estimates are rough, and to refuse
    is preflight's business.
    """
    devices = _devices(nodes, tuple(running), cuda=cuda)
    most = max((device.memory for device in devices), default=0)
    alone = [demand for demand in demands if demand.alone or demand.memory > most > 0]
    placed: list[Placed] = []
    for demand in alone[: len(devices)]:
        device = _for_one_alone(demand, devices)
        devices.remove(device)
        if not device.tasks:
            placed.append((demand.task, _whole(device)))
    assign = _assign_gpus if cuda else _assign_cpus
    return placed + assign([demand for demand in demands if demand not in alone], devices)


def able(nodes: Sequence[Node], *, cuda: bool) -> list[Node]:
    """The nodes on which tasks can run at all."""
    return [node for node in nodes if (node.gpus if cuda else node.cpus)]


def largest(nodes: Sequence[Node], *, cuda: bool) -> int:
    """Bytes of memory that a task has which is alone on the largest device; 0 if there is none."""
    return max((device.memory for device in _devices(nodes, (), cuda=cuda)), default=0)


def free_times(
    demands: Sequence[Demand], nodes: Sequence[Node], running: Sequence[Running], *, cuda: bool
) -> list[float]:
    """Seconds until each place for one of such tasks is free, 0 for those that are."""
    times, devices = list[float](), _devices(nodes, running, cuda=cuda)
    shares = _shares(demands, devices)
    for number, device in enumerate(devices):
        if cuda:
            times += [slot.free_in for slot in _slots(number, device, shares[number])]
        else:  # tasks share a node's cores, and take longer by as much: as one place for one after another
            times.append(sum(t.left * t.placement.cpus for t in device.tasks) / device.node.cpus)
    return times


def _devices(nodes: Sequence[Node], running: Sequence[Running], *, cuda: bool) -> list[_Device]:
    """All GPUs, or all nodes that have cores."""

    def on(node: Node, gpu: int | None) -> tuple[Running, ...]:
        return tuple(busy.get((node.id, gpu), ()))

    busy: dict[tuple[str, int | None], list[Running]] = {}
    for task in running:
        busy.setdefault((task.placement.node, task.placement.gpu), []).append(task)
    if cuda:
        cards = [(n, i) for n in nodes for i in range(len(n.gpus)) if i not in n.closed]
        return [_Device(n, i, n.gpus[i].memory, on(n, i)) for n, i in cards]
    return [_Device(n, None, int(n.memory * USABLE), on(n, None)) for n in nodes if n.cpus]


def _for_one_alone(demand: Demand, devices: Sequence[_Device]) -> _Device:
    """The device to try next: one with more memory than was not enough, or the largest there is."""
    larger = [device for device in devices if device.memory > demand.more_than]
    most = max(device.memory for device in devices)
    fitting = larger or [device for device in devices if device.memory == most]
    return min(
        fitting, key=lambda device: (device.free_in + _PATIENCE_S * demand.avoids(device), -device.memory)
    )


def _whole(device: _Device) -> Placement:
    if device.gpu is None:
        return Placement(device.node.id, device.node.cpus, device.memory)
    return _part(device, 1)


def _part(device: _Device, shares: int) -> Placement:
    """One of so many equal parts of a GPU, with the cores that go with it."""
    node, gpu = device.node, device.card
    cores = node.cpus / len(node.gpus) / shares
    return Placement(
        node.id,
        cpus=float(int(cores)) if cores >= 1 else int(cores * 1e4) / 1e4,  # Ray counts in such parts
        memory=gpu.memory // shares,
        gpus=int(1e4 / shares) / 1e4,
        gpu=device.gpu,
        uuid=gpu.uuid,
        pinned=node.differ,
        kind=_kind(gpu, shares),
    )


def _kind(gpu: Gpu, shares: int) -> str:
    return gpu.name if shares == 1 else f"1/{shares} {gpu.name}"


@dataclass(frozen=True, order=True)
class _Slot:
    """Room for one task on a GPU; of slots that are equally good, the least is taken."""

    free_in: float  # seconds
    full: float  # how full its GPU is then
    number: int  # of the GPU
    now: bool  # whether it can be given away now
    kind: str
    memory: int  # bytes of the GPU; 0 = unknown


def _assign_gpus(demands: Sequence[Demand], devices: Sequence[_Device]) -> list[Placed]:
    """On every slot that is free, the longest of the tasks that are assigned to it."""
    shares = _shares(demands, devices)
    slots = sorted(slot for i, device in enumerate(devices) for slot in _slots(i, device, shares[i]))
    if not demands or not any(slot.now for slot in slots):
        return []
    seconds = _seconds_on(demands, slots)
    avoided = _avoided(demands, [devices[slot.number] for slot in slots])
    slot_of = assign_lpt(seconds + _PATIENCE_S * avoided, np.array([slot.free_in for slot in slots]))
    placed: list[tuple[float, Placed]] = []
    for i, slot in enumerate(slots):
        assigned = np.flatnonzero(slot_of == i).tolist()
        if slot.now and assigned:
            task = max(assigned, key=lambda task: (-avoided[task, i], seconds[task, i]))
            place = _part(devices[slot.number], shares[slot.number])
            placed.append((-seconds[task, i], (demands[task].task, place)))
    return [one for _, one in sorted(placed, key=lambda pair: pair[0])]


def _seconds_on(demands: Sequence[Demand], slots: Sequence[_Slot]) -> Floats:
    """(T, S) seconds on each slot; inf on those of GPUs too small for a task, unless all are."""
    kinds = sorted({slot.kind for slot in slots})
    seconds = np.array([[demand.seconds(kind) for kind in kinds] for demand in demands])
    memory = np.array([slot.memory for slot in slots])
    fits = (memory == 0) | (memory >= np.array([[demand.memory] for demand in demands]))
    fits[~fits.any(axis=1)] = memory == memory.max()
    return np.where(fits, seconds[:, [kinds.index(slot.kind) for slot in slots]], np.inf)


def _avoided(demands: Sequence[Demand], devices: Sequence[_Device]) -> Floats:
    """(T, D) how much tasks avoid devices."""
    avoided = np.zeros((len(demands), len(devices)))
    for i, demand in enumerate(demands):
        if demand.avoid:
            avoided[i] = [demand.avoids(device) for device in devices]
    return avoided


def _shares(demands: Sequence[Demand], devices: Sequence[_Device]) -> list[int]:
    """How many tasks each GPU takes: as many as there is memory for the largest that fits it at all.

    No more than it gets where all are equally many, unless some have parts of that node already: Ray may have
    put these on any of its GPUs, and have no whole one left.
    """
    tasks = len(demands) + sum(task.left > 0 for device in devices for task in device.tasks)
    most = -(-tasks // max(1, len(devices)))
    cut = {device.node.id for device in devices for task in device.tasks if task.placement.gpus < 1}
    found = dict[int, int]()
    for memory in {device.memory for device in devices}:
        largest = max((demand.memory for demand in demands if demand.memory <= memory), default=memory)
        found[memory] = max(1, min(_SHARED, memory // max(1, largest)))
    return [found[d.memory] if d.node.id in cut else min(found[d.memory], max(1, most)) for d in devices]


def _slots(number: int, device: _Device, count: int) -> list[_Slot]:
    """The slots of a GPU that is to be cut into `count`, each from when its running tasks have made room."""

    def slot(free_in: float, full: float, *, now: bool) -> _Slot:
        return _Slot(free_in, full, number, now, _kind(device.card, count), device.memory)

    used = sum(task.placement.gpus for task in device.tasks)
    free = int((1 - used) * count + _EPSILON)
    slots = [slot(0.0, (count - free + i) / count, now=True) for i in range(free)]
    for task in sorted(device.tasks, key=lambda task: task.left):
        used -= task.placement.gpus
        more = int((1 - used) * count + _EPSILON) - len(slots)
        slots += [slot(task.left, 1.0, now=False)] * more
    return slots


def _assign_cpus(demands: Sequence[Demand], devices: Sequence[_Device]) -> list[Placed]:
    cores = [int(d.node.cpus - sum(task.placement.cpus for task in d.tasks)) for d in devices]
    memory = [d.memory - sum(task.placement.memory for task in d.tasks) for d in devices]
    assigned: list[list[Demand]] = [[] for _ in devices]
    room = [(-float(count), i) for i, count in enumerate(cores) if count > 0]  # a heap: most cores first
    heapify(room)
    refused = math.inf  # bytes that no device has any more
    for demand in sorted(demands, key=lambda demand: -demand.seconds("cpu")):
        if demand.memory >= refused:
            continue
        if (place := _take(demand, room, memory, devices)) is None:
            refused = demand.memory
            continue
        i = place[1]
        if (least := demand.avoids(devices[i])) and _is_worth_waiting(demand, least, devices, assigned):
            heappush(room, place)
            continue
        assigned[i].append(demand)
        memory[i] -= demand.memory
        if len(assigned[i]) < cores[i]:
            heappush(room, (-cores[i] / (len(assigned[i]) + 1), i))
    return [
        placed
        for i, tasks in enumerate(assigned)
        for placed in _share_cores(devices[i].node, cores[i], tasks)
    ]


def _take(
    demand: Demand, room: list[tuple[float, int]], memory: Sequence[int], devices: Sequence[_Device]
) -> tuple[float, int] | None:
    """Takes from a heap the first device with memory for a task, of those that it avoids least."""
    if demand.avoid:
        fitting = (place for place in room if demand.memory <= memory[place[1]])
        place = min(fitting, key=lambda it: (demand.avoids(devices[it[1]]), it), default=None)
        if place is not None:
            room.remove(place)
            heapify(room)
        return place
    passed: list[tuple[float, int]] = []
    while room and demand.memory > memory[room[0][1]]:
        passed.append(heappop(room))
    place = heappop(room) if room else None
    for one in passed:
        heappush(room, one)
    return place


def _is_worth_waiting(
    demand: Demand, least: float, devices: Sequence[_Device], assigned: Sequence[Sequence[Demand]]
) -> bool:
    """Whether a node that the task avoids less has room for it soon.

    Args: least, how much it avoids the best that is free; assigned, who starts where.
    """
    for device, tasks in zip(devices, assigned, strict=True):
        ends = [task.left for task in device.tasks] + [task.seconds("cpu") for task in tasks]
        fits = demand.memory <= device.memory and demand.avoids(device) < least
        if fits and ends and min(ends) <= _PATIENCE_S:
            return True
    return False


def _share_cores(node: Node, cores: int, demands: Sequence[Demand]) -> list[Placed]:
    """The cores of a node for those that start on it together; the first get what is over."""
    each, over = divmod(cores, len(demands)) if demands else (0, 0)
    return [
        (demand.task, Placement(node.id, float(each + (i < over)), demand.memory))
        for i, demand in enumerate(demands)
    ]
