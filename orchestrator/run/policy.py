"""What a run does next: pure decisions over a `RunState`, so that they are tested without Ray."""

from dataclasses import dataclass
from itertools import pairwise

from panolog.orchestrator.run.control import PAUSE, RETRY, STOP, UNPAUSE, Request, notice
from panolog.orchestrator.run.records import (
    INPUT,
    LOST,
    MEMORY,
    PauseRequested,
    Record,
    RetryRequested,
    UnpauseRequested,
)
from panolog.orchestrator.run.state import (
    DONE,
    FAILED,
    PAUSED,
    RUNNING,
    WAITING,
    RunState,
    TaskState,
    block_task,
    score_task,
)

LOSSES = 5  # attempts in a row, without a checkpoint, that may be lost with their process or machine
STAGES = ("coarse", "score", "plan", "block", "merge", "eval")


def ready(state: RunState, *, shards: int, refine: bool) -> tuple[str, ...]:
    """The tasks that may start now, in the order in which they should.

    Stage I, scoring in `shards` parts, the plan, the blocks longest first, the merge, the evaluation: each
    waits for all before it. A block that has failed for good holds nobody up, one that is paused does.
    Without `refine` the merge follows Stage I.
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
    unfinished = any(task.status in (RUNNING, PAUSED) for task in state.tasks.values())
    if unfinished or ready(state, shards=shards, refine=refine):
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


def trains(name: str) -> bool:
    """Whether a task has checkpoints."""
    return name == "coarse" or name.startswith("block/")


def shards_of(train: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """The training cameras as they are scored. A function of them alone, so shards stay valid."""
    size = min(64, max(4, len(train) // 16))
    return shard_cameras(train, -(-len(train) // size))


def shard_cameras(cameras: tuple[int, ...], shards: int) -> tuple[tuple[int, ...], ...]:
    """The cameras split into `shards` runs of neighbours of nearly equal length, none empty."""
    shards = max(1, min(shards, len(cameras)))
    edges = [len(cameras) * i // shards for i in range(shards + 1)]
    return tuple(cameras[a:b] for a, b in pairwise(edges))


@dataclass(frozen=True)
class Verdict:
    """What follows from a failed attempt."""

    final: bool
    then: str = ""  # for people, where there is more to say than whether it is tried again


def after_failure(task: TaskState, failure: str, *, retries: int, memory: int, largest: int) -> Verdict:
    """What follows from one more failed attempt at a task.

    Wrong input stays wrong. One that failed through the task itself may be followed by `retries` others,
    counted anew from each checkpoint. One that was lost with its process or its machine is none of those:
    `LOSSES` in a row without a checkpoint are too many. After the first shortage of memory the task gets a
    smaller image cache and a device for itself, after another a device with more memory.

    Args: failure, a kind of `records`; memory, bytes that the place of the attempt had; largest, bytes of the
    largest device there is.
    """
    if failure == LOST:
        return Verdict(final=task.losses >= LOSSES)
    if failure == INPUT or task.errors >= retries:
        return Verdict(final=True)
    if failure != MEMORY:
        return Verdict(final=False)
    if not task.shortages:
        return Verdict(False, "tried again with a smaller image cache and nothing beside it")
    if memory < largest:
        return Verdict(False, "tried again on a larger device")
    return Verdict(True, "no device has more memory: take a smaller --width or cap densify.max_gaussians")


def refusal(state: RunState, request: Request) -> str | None:
    """Why a request makes no sense as the run stands; None if it does."""
    if request.action == STOP:
        return None
    trained = [block.block for block in state.plan or () if block.train]
    if state.plan is None:
        return "there are no blocks yet"
    if request.block not in trained:
        return f"there is no block {request.block} to train"
    task = state.task(request.task)
    over = task.status in (DONE, FAILED)
    reasons = {
        PAUSE: "it is paused" if task.held else f"it is {task.status}" if over else None,
        UNPAUSE: None if task.held else "it is not paused",
        RETRY: _no_retry(state, task),
    }
    return reasons[request.action]


def _no_retry(state: RunState, task: TaskState) -> str | None:
    if task.status == DONE or not (task.status == FAILED or task.errors or task.losses or task.shortages):
        return "it has not failed"
    if state.status("merge") == DONE:
        return "the blocks are merged: `panolog resume` tries it again after the end of the run"
    return None


_WISHES: dict[str, type[PauseRequested | UnpauseRequested | RetryRequested]] = {
    PAUSE: PauseRequested,
    UNPAUSE: UnpauseRequested,
    RETRY: RetryRequested,
}


def answer(state: RunState, request: Request) -> Record:
    """The record of a request about a block, or a notice if it makes no sense now."""
    if (why := refusal(state, request)) is not None:
        return notice(f"{request}: {why}")
    return _WISHES[request.action](request.task)
