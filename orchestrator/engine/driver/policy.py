"""What a run does next, and what follows a failure: pure functions of a `RunState`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from panolog.orchestrator.runs.records import Failure, Outcome
from panolog.orchestrator.runs.state import RunState, Status, TaskState
from panolog.workers.tasks import COARSE, DELIVER, EVAL, MERGE, PLAN, Stage, TaskId

_NAMED = 10  # blocks in a message, at most
LOSSES = 5  # attempts in a row, without a checkpoint, that may be lost with their process or machine


def ready(
    state: RunState, *, shards: int, refine: bool, districts: int = 1, deliver: bool = False
) -> tuple[TaskId, ...]:
    """The tasks that may start now, in the order in which they should.

    Stage I, of several `districts` each apart and then their union, scoring in `shards` parts, the plan, the
    blocks longest first, their union and what trains once more in it, the merge, the evaluation, perhaps in
    shards and then as one, and the delivery: each waits for all before it. A block that has failed for good
    holds no stage up, one that is paused does. Without `refine` the merge follows Stage I. Where a limit has
    ended the training, the merge follows at once, if there is anything to merge, and the evaluation comes
    last: it alone needs a machine, and there may be none.
    """
    stages: list[tuple[TaskId, ...]] = []
    if state.money.reached is not None:
        if not _trained(state):
            return ()
    else:
        stages = list(_training(state, shards=shards, refine=refine, districts=districts))
    delivery, measured = [(DELIVER,)] if deliver else [], [state.measures, (EVAL,)]
    stages += [(MERGE,), *delivery, *measured] if state.money.reached else [(MERGE,), *measured, *delivery]
    for tasks in stages:
        waiting = tuple(task for task in tasks if state.status(task) == Status.WAITING)
        unfinished = any(not _over(state, task) for task in tasks)
        if waiting or unfinished:
            return waiting
    return ()


def _training(state: RunState, *, shards: int, refine: bool, districts: int) -> Iterator[tuple[TaskId, ...]]:
    if districts > 1:
        yield tuple(map(TaskId.district, range(districts)))
    yield (COARSE,)
    if refine:
        yield from (tuple(map(TaskId.shard, range(shards))), (PLAN,), state.blocks)
        yield from state.between


def _trained(state: RunState) -> bool:
    """Whether Stage I has come to anything: a model, or a checkpoint of one."""
    first = [task for task in state.tasks.values() if task.id.stage in (Stage.DISTRICT, Stage.COARSE)]
    return any(task.status == Status.DONE or task.checkpoint is not None for task in first)


def outcome(state: RunState, ready: Sequence[TaskId]) -> tuple[Outcome, str] | None:
    """How the run has ended, with the reason of a failure; None while there is something to do."""
    for task in state.tasks.values():
        if task.status == Status.FAILED and not task.id.stage.refines:
            return Outcome.FAILED, f"{task.id} failed: {task.reasons[-1]}"
    reached = state.money.reached
    held = (Status.RUNNING,) if reached else (Status.RUNNING, Status.PAUSED)
    unfinished = any(task.status in held for task in state.tasks.values())
    if unfinished or ready:
        return None
    if reached is not None:
        return Outcome.LIMITED, reached.reason
    failed = state.failed_blocks()
    if failed:
        names = ", ".join(map(str, failed[:_NAMED]))
        names += f" and {len(failed) - _NAMED} more" if len(failed) > _NAMED else ""
        return Outcome.FAILED, f"block {names} failed and keeps its Stage I Gaussians"
    if lost := [str(task.id) for task in state.tasks.values() if task.status == Status.FAILED]:
        return (
            Outcome.FAILED,
            f"failed, so that part of the model stays as it was: {', '.join(lost[:_NAMED])}",
        )
    return Outcome.DONE, ""


def _over(state: RunState, task: TaskId) -> bool:
    if task.stage.refines:
        return state.status(task) in (Status.DONE, Status.FAILED)
    return state.status(task) == Status.DONE


@dataclass(frozen=True)
class Consequence:
    """What follows from a failed attempt."""

    final: bool
    then: str = ""  # what is done about it, if more than another attempt


def after_failure(
    task: TaskState,
    failure: Failure,
    *,
    node: str,
    others: bool,
    retries: int,
    memory: int,
    largest: int,
    preemptions: int | None = None,
) -> Consequence:
    """What follows from one more failed attempt at a task.

    Input is wrong if a second node finds it wrong, or a second attempt where there is no other node: one
    alone may have a bad disk. An attempt that failed through the task itself may be followed by `retries`
    others, counted anew from each checkpoint. One that was lost with its process or its machine is none of
    those: `LOSSES` in a row without a checkpoint are too many. Those that were lost with a node that had
    announced that it leaves have a limit of their own. After the first shortage of memory the task gets a
    smaller image cache and a device for itself, after another a device with more memory.

    Args: node, Node.id of the attempt; others, whether the task could run on another; memory, bytes that the
    attempt had; largest, bytes of the largest device there is; preemptions, `RunConfig.preemptions` if the
    node had announced that it leaves.
    """
    if preemptions is not None:
        final = 0 <= preemptions <= task.preemptions
        return Consequence(final, "" if final else "its machine has left: it continues on another")
    if failure == Failure.LOST:
        return Consequence(final=task.losses >= LOSSES)
    if task.errors >= retries:
        return Consequence(final=True)
    if failure == Failure.INPUT:
        before = [failure.where for failure in task.failures if failure.kind == Failure.INPUT]
        confirmed = [where for where in before if node not in where] if others else before
        return Consequence(
            bool(confirmed), "" if confirmed else "tried again before the input counts as wrong"
        )
    if failure != Failure.MEMORY:
        return Consequence(final=False)
    if not task.shortages:
        return Consequence(False, "tried again with a smaller image cache and nothing else on its device")
    if memory < largest:
        return Consequence(False, "tried again on a larger device")
    return Consequence(True, "no device has more memory: take a smaller --width or cap densify.max_gaussians")
