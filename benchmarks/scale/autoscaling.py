"""Machine hours where an autoscaler starts and ends machines, against those of the work alone.

    python -m benchmarks.scale.autoscaling [--machines 16] [--minutes 10,30,120] [--overhead 0.1] [--seeds 3]
    python -m benchmarks.scale.autoscaling --quick

The driver's own decisions (`expected`, `scaling` and `placement` in orchestrator/resources/) are simulated on
a clock that moves by five seconds. A run is Stage I on one machine, the partition, the blocks, the merge,
which needs no machine, and the evaluation on one. The simulated autoscaler looks for requests every five
seconds; a machine joins 1 to 5 minutes later, and goes when it has been idle for a minute. It costs from its
request to its end. Costs of blocks are those of `scheduling`, recorded, so long that a block takes as many
minutes as given on average, and those of cities: what the estimator expects on an RTX 4090 of the panoramas
and Gaussians of each block, 5 % more or less.

The lower bound is the work alone, on machines that cost nothing else: no start, no idle second. `always on`
is as many machines as there may be, from the start of the run to its end.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import mean

import numpy as np

from benchmarks import report
from benchmarks.scale.laws import settings
from benchmarks.scale.machines import DISTRICT, RTX_4090, WIDTH, basis_on
from benchmarks.scale.models import PER_BLOCK
from benchmarks.scale.places import city
from benchmarks.scheduling import Block, recorded, simulate
from benchmarks.three_days.cluster import VirtualClock
from panolog.orchestrator.estimates import costs
from panolog.orchestrator.estimates.estimate import Estimator
from panolog.orchestrator.estimates.suggestions import balanced
from panolog.orchestrator.resources import placement
from panolog.orchestrator.resources.expected import Expected
from panolog.orchestrator.resources.nodes import Node, Placement
from panolog.orchestrator.resources.placement import Demand, Running
from panolog.orchestrator.resources.scaling import IDLE_S, Group, Growth, Work
from panolog.orchestrator.run.config import change
from panolog.orchestrator.run.machines.config import ScalingConfig
from panolog.orchestrator.stages.partitioning import block_labels
from panolog.partition.contraction import contract
from panolog.workers.tasks import EVAL, Stage, TaskId

_TICK_S = 5.0
_STARTUP_S = (60.0, 300.0)  # of a machine
_AGENT_S = 5.0  # for which the run's agent keeps a machine from being idle
_PLAN_S, _MERGE_S, _EVAL_S = 30.0, 120.0, 180.0  # of the recorded runs
_GOAL = 1.15  # times the lower bound
_MEMORY = 23 * 2**30
_NOISE = 0.05  # of a city's blocks
_ESTIMATE = 0.2  # of the logarithm of what is expected of a stage before it begins


@dataclass(frozen=True)
class Case:
    """The work of a run: seconds of a machine."""

    name: str
    coarse: tuple[float, ...]  # of Stage I, or of each district
    blocks: tuple[Block, ...]
    merge: float = _MERGE_S  # without a machine
    evaluation: float = _EVAL_S

    @property
    def work(self) -> float:
        """Of all tasks."""
        return sum(self.coarse) + sum(block.seconds for block in self.blocks) + self.evaluation


@dataclass(frozen=True)
class Row:
    """One run."""

    case: str
    most: int
    machines: int  # at once
    hours: float  # of machines
    ratio: float  # of these to the lower bound
    seconds: float  # of the run
    one: float  # the same on one machine that is there
    always: float  # machine hours to the lower bound if all were always on
    fixed: float  # seconds of the run then


@dataclass
class _Machine:
    node: Node
    requested: float
    joins: float
    used: float  # when something last ran there
    gone: float = np.inf


class Simulation:
    """One run with one autoscaler."""

    def __init__(self, case: Case, most: int, overhead: float, seed: int) -> None:
        self._case = case
        self._overhead = overhead
        self._random = np.random.default_rng(seed)
        self._clock = VirtualClock(0.0, 0.0)
        self._expected = Expected(self._clock)
        self._group = Group("gpu", most, cpus=8, gpus=1, accelerator="L4", memory=2**36)
        self._machines: list[_Machine] = []
        self._running: dict[TaskId, tuple[Placement, float, float]] = {}  # where, from when, until when
        self._done: set[TaskId] = set()
        self._requests = 0

    def run(self) -> tuple[float, float, int]:
        """Seconds of the run, seconds of its machines, and how many there were at once."""
        case = self._case
        coarse = {TaskId.district(number): seconds for number, seconds in enumerate(case.coarse)}
        blocks = {TaskId.block(number): block.seconds for number, block in enumerate(case.blocks)}
        for tasks, pause in ((coarse, _PLAN_S), (blocks, case.merge), ({EVAL: case.evaluation}, 0.0)):
            self._stage(tasks)
            self._requests = 0
            for _ in range(round(pause / _TICK_S)):
                self._tick()
        end = self._clock.now
        ends = [min(machine.gone, end + IDLE_S + _AGENT_S) for machine in self._machines]
        spans = [(m.requested, last) for m, last in zip(self._machines, ends, strict=True)]
        most = max(sum(first <= start < last for first, last in spans) for start, _ in spans)
        return end, sum(last - first for first, last in spans), most

    def _stage(self, tasks: dict[TaskId, float]) -> None:
        waiting, estimate = dict(tasks), sum(tasks.values()) * self._random.lognormal(0, _ESTIMATE)
        while waiting or self._running:
            for task, place in self._decide(tasks, waiting, estimate):
                now = self._clock.now
                self._running[task] = place, now, now + waiting.pop(task)
            self._tick()

    def _decide(
        self, tasks: dict[TaskId, float], waiting: dict[TaskId, float], estimate: float
    ) -> list[tuple[TaskId, Placement]]:
        """What starts now, as `driver.machines.Machines.place` decides it."""
        now, there = self._clock.now, [m for m in self._machines if m.joins <= self._clock.now < m.gone]
        nodes = [machine.node for machine in there]
        growth = Growth((self._group,), {node.id: self._group.name for node in nodes})
        predicted, whole = self._predicted(tasks, estimate)
        left = [
            (
                place,
                last - now if now - first > costs.WELL * (last - first) else predicted[task] - now + first,
            )
            for task, (place, first, last) in self._running.items()
        ]
        running = [Running(place, max(0.0, seconds)) for place, seconds in left]
        demands = [Demand(task, int(0.6 * _MEMORY), _always(predicted[task])) for task in waiting]
        work = Work(demands, [predicted[task] for task in waiting], whole)
        scaling = self._expected.scaling(growth, nodes, self._overhead, lambda _: None, cuda=True)
        come = self._expected.decide(scaling, work, running, nodes, patience=600.0)
        self._requests = come.wanted.get(self._group.name, 0)
        return placement.place(demands, [*nodes, *come.nodes], [*running, *come.fill], cuda=True)

    def _predicted(self, tasks: dict[TaskId, float], estimate: float) -> tuple[dict[TaskId, float], float]:
        """Seconds of each task of a stage and of all, as `driver.demands.Demands.work` knows them."""
        blocks = {task: self._case.blocks[task.number] for task in tasks if task.stage.refines}
        done = [
            costs.BlockTime(blocks[task].cameras, blocks[task].gaussians, "", seconds)
            for task, seconds in tasks.items()
            if task in blocks and self._is_known(task)
        ]
        model = costs.fit(done)
        found = {task: model.seconds(b.cameras, b.gaussians, "") for task, b in blocks.items()}
        found = found or dict.fromkeys(tasks, 1.0)
        if done:
            return found, costs.in_all(done, [(b.cameras, b.gaussians) for b in blocks.values()])
        scale = estimate / sum(found.values())
        return {task: scale * seconds for task, seconds in found.items()}, estimate

    def _is_known(self, task: TaskId) -> bool:
        """Whether a block is done or well on its way."""
        if task in self._running:
            _, first, last = self._running[task]
            return self._clock.now - first >= costs.WELL * (last - first)
        return task in self._done

    def _tick(self) -> None:
        """Lets five seconds pass: tasks end, idle machines go, the autoscaler starts what is requested."""
        self._clock.sleep(_TICK_S)
        now = self._clock.now
        for task, (place, _, last) in list(self._running.items()):
            machine = next(m for m in self._machines if m.node.id == place.node)
            machine.used = min(now, last)
            if last <= now:
                del self._running[task]
                self._done.add(task)
        for machine in self._machines:
            idle = now - max(machine.used, machine.joins)
            if machine.joins <= now < machine.gone and idle >= IDLE_S + _AGENT_S:
                machine.gone = now
        self._requests -= sum(now - _TICK_S < machine.joins <= now for machine in self._machines)
        coming = sum(machine.joins > now for machine in self._machines)
        alive = sum(now < machine.gone for machine in self._machines)
        for _ in range(min(self._requests - coming, self._group.most - alive)):
            joins = now + self._random.uniform(*_STARTUP_S)
            name = f"machine {len(self._machines)}"
            node = replace(self._group.node(0), id=name, host=name)
            self._machines.append(_Machine(node, now, joins, joins))


def _always(seconds: float) -> Callable[[str], float]:
    return lambda _: seconds


def measure(case: Case, most: int, overhead: float, seeds: int) -> Row:
    """A run, on average over so many seeds."""
    runs = [Simulation(case, most, overhead, seed).run() for seed in range(seeds)]
    seconds, hours, machines = (mean(values) for values in zip(*runs, strict=True))
    pauses = _PLAN_S + case.merge
    fixed = simulate([*case.blocks], {str(number): 1.0 for number in range(most)})
    always = fixed + sum(case.coarse) / min(most, len(case.coarse)) + case.evaluation + pauses
    return Row(
        case=case.name,
        most=most,
        machines=round(machines),
        hours=hours / 3600,
        ratio=hours / case.work,
        seconds=seconds,
        one=case.work + pauses,
        always=most * always / case.work,
        fixed=always,
    )


def recorded_cases(minutes: Sequence[float]) -> Iterator[Case]:
    """The recorded runs, their blocks so many minutes long on average; Stage I as long as the longest."""
    for name, blocks in recorded().items():
        average = mean(block.seconds for block in blocks)
        for length in minutes:
            scaled = [replace(b, seconds=b.seconds * 60 * length / average) for b in blocks]
            yield Case(f"{name}, {length:g} min", (max(b.seconds for b in scaled),), tuple(scaled))


def city_case(panoramas: int, seed: int = 0) -> Case:
    """A city of so many panoramas, with as many districts and blocks as in `scale.machines`."""
    scene = city(panoramas, WIDTH)
    config = change(settings(WIDTH, "cuda"), {"districts": max(1, panoramas // DISTRICT)})
    config = change(config, balanced(scene, config, max(2, round(panoramas / PER_BLOCK))))
    estimator = Estimator(scene, config, basis_on(scene, config, RTX_4090), ())
    estimate, train = estimator.estimate(), np.array(scene.train)
    box = config.partition.box(scene.centers[train])
    cameras = np.bincount(
        config.grid.block_of(contract(scene.centers[train], box)), minlength=config.grid.count
    )
    points = np.bincount(
        block_labels(scene, scene.points.astype(np.float32), config), minlength=config.grid.count
    )
    random, each = np.random.default_rng(seed), estimate.coarse / len(scene.points)
    blocks = []
    for own, views in zip((points * each).astype(int).tolist(), cameras.tolist(), strict=True):
        seconds = estimator.block(estimate.coarse, own, views).seconds if views else None
        if seconds:
            blocks.append(Block(views, own, seconds * random.lognormal(0, _NOISE)))
    of = {stage.name: (stage.seconds or 0.0, stage.tasks) for stage in estimate.stages}
    whole, districts = of.get(Stage.DISTRICT) or of[Stage.COARSE]
    evaluation = of[Stage.MEASURE][0] if Stage.MEASURE in of else of[Stage.EVAL][0]
    merge = of[Stage.MERGE][0]
    return Case(f"city of {panoramas:,}", (whole / districts,) * districts, tuple(blocks), merge, evaluation)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("scale.autoscaling", __doc__)
    parser.add_argument("--machines", type=int, default=16, help="machines at once (16)")
    parser.add_argument(
        "--minutes", type=report.numbers, default=[10, 30, 120], help="of a block (10,30,120)"
    )
    parser.add_argument("--cities", type=report.numbers, default=[1200, 5000], help="panoramas (1200,5000)")
    parser.add_argument("--overhead", type=float, default=ScalingConfig().overhead, help="scaling.overhead")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each (3)")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        minutes, cities = ([30], [300]) if options.quick else (options.minutes, options.cities)
        cases = [*recorded_cases(minutes), *map(city_case, cities)]
        rows = [measure(case, options.machines, options.overhead, options.seeds) for case in cases]
        head = (
            "run",
            "machines",
            "machine hours",
            "to the work",
            "always on",
            "hours",
            "on one",
            "always on",
        )
        table = [
            (
                *(row.case, row.machines, row.hours, row.ratio, row.always),
                *(row.seconds / 3600, row.one / 3600, row.fixed / 3600),
            )
            for row in rows
        ]
        worst = max(row.ratio for row in rows)
        text = f"at most {worst:.3f} times the work alone; the goal is {_GOAL}"
        content = {"rows": [asdict(row) for row in rows], "worst": worst}
        return report.Report(content, f"{report.markdown(head, table)}\n\n{text}", worst <= _GOAL)

    return report.run("scale.autoscaling", options, work)


if __name__ == "__main__":
    sys.exit(main())
