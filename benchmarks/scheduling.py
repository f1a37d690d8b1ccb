"""The driver's order and placement of blocks against the best possible, on costs recorded from real runs.

    python -m benchmarks.scheduling [--json]

The driver's own decisions (`placement` and `costs` in the engine) are simulated on a clock that jumps from
one event to the next. They know cameras and Gaussians of all blocks, and the duration of a block once 5 % of
it are done: from its rate, which is constant here. The best possible knows all durations in advance; it is
the lower bound that HiGHS proves for "each block on one GPU, the last to finish as soon as possible".

The recorded costs are those of Stage II on a CPU. There all blocks refine the whole Stage I model, so they
differ by at most a third. The generated ones, drawn around a power of cameras × Gaussians, differ by a factor
of more than ten.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import LinearConstraint, milp

from benchmarks import report
from panolog.orchestrator.engine.estimates import costs
from panolog.orchestrator.engine.scheduling import placement
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.workers.tasks import TaskId

RECORDED = Path(__file__).with_name("block_costs.json")
MEMORY = 24 * 2**30  # bytes of every GPU; each block takes most of one
GAP = 0.002  # between the bound and the best assignment that is known, for runs of many blocks
NODES = 10_000  # of the search for the best possible, at most: the same on every machine


@dataclass(frozen=True)
class Block:
    """What is known of a block in advance, and its duration on a GPU of slowness 1."""

    cameras: int
    gaussians: int
    seconds: float


Machines = Mapping[str, float]  # slowness of each GPU, by its name
MACHINES: dict[str, Machines] = {
    "1 GPU": {"a": 1.0},
    "2 GPUs": {"a": 1.0, "b": 1.0},
    "4 GPUs": dict.fromkeys("abcd", 1.0),
    "2 and 1 of half the speed": {"a": 1.0, "b": 1.0, "c": 2.0},
    "1 and 1 at 60 %": {"a": 1.0, "b": 1 / 0.6},
}


def simulate(blocks: Sequence[Block], machines: Machines) -> float:
    """Seconds until the last block is done."""
    nodes = [
        Node(name, name, 4, 2**40, (Gpu(f"slowness {slow:g}", MEMORY),)) for name, slow in machines.items()
    ]
    waiting = dict(enumerate(blocks))
    running: dict[int, tuple[Placement, float, float]] = {}  # where, since when, for how long
    done: list[costs.BlockTime] = []
    now = 0.0
    while waiting or running:
        begun = [
            _sample(blocks[name], place, seconds)
            for name, (place, since, seconds) in running.items()
            if now - since >= costs.WELL * seconds
        ]
        model = costs.fit(done + begun)
        requests = [_request(name, block, model) for name, block in waiting.items()]
        busy = [_running(blocks[name], model, now, *task) for name, task in running.items()]
        for task, place in placement.place(requests, nodes, busy, cuda=True):
            block = waiting.pop(task.number)
            running[task.number] = place, now, block.seconds * machines[place.node]
        first = min(running, key=lambda name: running[name][1] + running[name][2])
        place, since, seconds = running.pop(first)
        now = since + seconds
        done.append(_sample(blocks[first], place, seconds))
    return now


def best_possible(seconds: Sequence[float], machines: Machines) -> float:
    """A lower bound of the makespan of every assignment of the blocks, in seconds."""
    slow = np.array(list(machines.values()))
    count, gpus = len(seconds), len(slow)
    cost = np.append(np.zeros(count * gpus), 1.0)  # x[block, gpu] in {0, 1}, then the makespan
    once = np.zeros((count, len(cost)))
    load = np.zeros((gpus, len(cost)))
    for block, second in enumerate(seconds):
        once[block, block * gpus : (block + 1) * gpus] = 1
        load[:, block * gpus : (block + 1) * gpus] = np.diag(second * slow)
    load[:, -1] = -1
    result = milp(
        cost,
        integrality=np.append(np.ones(count * gpus), 0),
        bounds=(0, np.append(np.ones(count * gpus), np.inf)),
        constraints=[LinearConstraint(once, 1, 1), LinearConstraint(load, -np.inf, 0)],
        options={"mip_rel_gap": GAP if count > 20 else 0.0, "node_limit": NODES},
    )
    return max(float(result.mip_dual_bound), preemptive(seconds, machines))


def preemptive(seconds: Sequence[float], machines: Machines) -> float:
    """The makespan if blocks could be moved at any moment (Horvath, Lam and Sethi, 1977)."""
    work = np.cumsum(sorted(seconds, reverse=True))
    speed = np.cumsum(sorted((1 / slow for slow in machines.values()), reverse=True))
    some = [work[i] / speed[i] for i in range(min(len(work), len(speed)))]
    return float(max([*some, work[-1] / speed[-1]]))


def recorded() -> dict[str, list[Block]]:
    """The costs in block_costs.json, by the name of the run."""
    runs = json.loads(RECORDED.read_text())["runs"]
    return {name: [Block(**block) for block in blocks] for name, blocks in runs.items()}


def generated(count: int = 10) -> dict[str, list[Block]]:
    """Runs of 12 to 60 blocks whose seconds are log-normal around a power of cameras and Gaussians."""
    random = np.random.default_rng(4)
    runs = {}
    for number in range(count):
        blocks = []
        exponent = random.uniform(0.2, 0.6)
        for _ in range(int(random.integers(12, 61))):
            cameras, gaussians = int(random.lognormal(4, 0.7)) + 1, int(random.lognormal(12, 0.8))
            seconds = (cameras * gaussians) ** exponent * random.lognormal(0, 0.1)
            blocks.append(Block(cameras, gaussians, float(seconds)))
        runs[f"generated {number}"] = blocks
    return runs


def excess(blocks: Sequence[Block], machines: Machines) -> float:
    """The simulated makespan over the best possible, less one."""
    return simulate(blocks, machines) / best_possible([block.seconds for block in blocks], machines) - 1


def _request(name: int, block: Block, model: costs.CostModel) -> placement.Demand:
    seconds = costs.predictor(model, block.cameras, block.gaussians)
    return placement.Demand(TaskId.block(name), int(0.6 * MEMORY), seconds)


def _sample(block: Block, place: Placement, seconds: float) -> costs.BlockTime:
    return costs.BlockTime(block.cameras, block.gaussians, place.kind, seconds)


def _running(
    block: Block, model: costs.CostModel, now: float, place: Placement, since: float, seconds: float
) -> placement.Running:
    if now - since < costs.WELL * seconds:
        seconds = model.seconds(block.cameras, block.gaussians, place.kind)
    return placement.Running(place, max(0.0, seconds - (now - since)))


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("scheduling", __doc__, quick=False)
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        runs = recorded() | generated()
        found = {
            name: {case: excess(blocks, machines) for case, machines in MACHINES.items()}
            for name, blocks in runs.items()
        }
        head = ("excess over the best possible", "blocks", *MACHINES)
        rows = [
            (name, len(runs[name]), *(f"{value:+.1%}" for value in values.values()))
            for name, values in found.items()
        ]
        return report.Report({"excess": found}, report.markdown(head, rows))

    return report.run("scheduling", options, work)


if __name__ == "__main__":
    sys.exit(main())
