"""What a run does next: pure decisions over a `RunState`, so that they are tested without Ray."""

from dataclasses import dataclass
from itertools import pairwise

from panolog.orchestrator.state import DONE, FAILED, RUNNING, WAITING, RunState, block_task, score_task

STAGES = ("coarse", "score", "plan", "block", "merge", "eval")


def ready(state: RunState, *, shards: int, refine: bool) -> tuple[str, ...]:
    """The tasks that may start now, in the order in which they should.

    Stage I, scoring in `shards` parts, the plan, the blocks longest first, the merge, the evaluation: each
    waits for all before it. A block that has failed for good holds nobody up. Without `refine` the merge
    follows Stage I.
    """
    stages: list[tuple[str, ...]] = [("coarse",)]
    if refine:
        stages += [tuple(score_task(shard) for shard in range(shards)), ("plan",), block_order(state)]
    stages += [("merge",), ("eval",)]
    for names in stages:
        waiting = tuple(name for name in names if state.status(name) == WAITING)
        unfinished = any(not _over(state, name) for name in names)
        if waiting or unfinished:
            return waiting
    return ()


def block_order(state: RunState) -> tuple[str, ...]:
    """The blocks to train, longest first; none before the plan.

    All train for as many iterations: what counts is how many Gaussians they refine, then how many panoramas
    they decode.
    """
    blocks = [block for block in state.plan or () if block.train]
    blocks.sort(key=lambda block: (-block.gaussians, -block.cameras, block.block))
    return tuple(block_task(block.block) for block in blocks)


def outcome(state: RunState, *, shards: int, refine: bool) -> tuple[str, str] | None:
    """How the run has ended, "done" or "failed", with the reason; None while there is something to do."""
    for name, task in state.tasks.items():
        if task.status == FAILED and not name.startswith("block/"):
            return "failed", f"{name} failed: {task.reasons[-1]}"
    running = any(task.status == RUNNING for task in state.tasks.values())
    if running or ready(state, shards=shards, refine=refine):
        return None
    failed = state.failed_blocks()
    if failed:
        names = ", ".join(map(str, failed))
        return "failed", f"block {names} failed and keeps its Stage I Gaussians; `panolog resume` tries again"
    return "done", ""


def _over(state: RunState, name: str) -> bool:
    if name.startswith("block/"):
        return state.status(name) in (DONE, FAILED)
    return state.status(name) == DONE


@dataclass(frozen=True)
class Machine:
    """What there is to run tasks on: one machine, or all nodes of a cluster."""

    cpus: int  # cores of all nodes
    node_cpus: int  # cores of the largest node: no task can have more
    gpus: int
    gpu_cpus: int  # cores for each GPU on the node that has fewest of them
    memory: int | None  # bytes for all tasks on the CPU; None on a cluster, where Ray looks after it


@dataclass(frozen=True)
class Share:
    """What one of several tasks that run beside each other gets of the machine."""

    cpus: int
    gpus: int


def share(tasks: int, machine: Machine, *, device: str, fit: int) -> Share:
    """Cores and GPUs for each of `tasks` that are ready together.

    On CUDA each has a GPU of its own and the cores that go with it. On the CPU as many run at once as there
    are cores and as `fit` into memory, because one thread each wastes less than many threads for one; the
    results do not depend on it.

    Args: device "cpu" or "cuda"; fit, how many tasks memory holds.
    """
    if device == "cuda":
        return Share(cpus=max(1, machine.gpu_cpus), gpus=1)
    together = max(1, min(tasks, machine.cpus, fit))
    return Share(cpus=max(1, min(machine.cpus // together, machine.node_cpus)), gpus=0)


def shard_cameras(cameras: tuple[int, ...], shards: int) -> tuple[tuple[int, ...], ...]:
    """The cameras split into `shards` runs of neighbours of nearly equal length, none empty."""
    shards = max(1, min(shards, len(cameras)))
    edges = [len(cameras) * i // shards for i in range(shards + 1)]
    return tuple(cameras[a:b] for a, b in pairwise(edges))


def may_retry(attempt: int, retries: int, *, user_error: bool) -> bool:
    """Whether a failed attempt (1 for the first) is followed by another. Wrong input stays wrong."""
    return not user_error and attempt <= retries
