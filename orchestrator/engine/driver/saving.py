"""From the events of workers to the content of the run folder: an event's files first, then its record."""

import errno
import logging
import math
import shutil
import socket
from dataclasses import asdict, replace
from pathlib import Path

from typing_extensions import assert_never

from panolog.orchestrator.engine.stages.captures import save_captured
from panolog.orchestrator.runs import thinning
from panolog.orchestrator.runs.clock import Clock
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.usage import INTERVAL_S, Usage
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    ModelSaved,
    Noticed,
    PreviewSaved,
    Progressed,
    Record,
    ScoresSaved,
    SeamEvaluated,
    Transferred,
    ViewEvaluated,
)
from panolog.orchestrator.runs.state import RunState, Status
from panolog.partition.scores import write_scores
from panolog.scene.files import publish, remove_partial, write_bytes
from panolog.scene.model import Scene
from panolog.scene.ply import write_ply
from panolog.workers.events import (
    Checkpoint,
    CheckpointWritten,
    Evaluated,
    Event,
    Notice,
    Preview,
    Scored,
    SeamMeasured,
    Trained,
)
from panolog.workers.tasks import COARSE, Progress, TaskId, Transfer
from panolog.workers.training import checkpoint
from panolog.workers.training.checkpointing import Outbox

_LOG = logging.getLogger(__name__)
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)  # of file systems without hard links


def save(folder: RunFolder, event: Event, scene: Scene, keep: int = 1) -> Record:
    """Puts what an event carries into the run folder, atomically, and returns the record of it.

    Args: scene, that of the run; keep, how many checkpoints of a task stay, with this one.

    Raises OSError or RunError if the disk does not take it.
    """
    match event:
        case Progress():
            return Progressed(**vars(event))
        case Notice():
            return Noticed(event.task, event.message)
        case Evaluated():
            return ViewEvaluated(event.task, event.view, event.metrics)
        case SeamMeasured():
            return SeamEvaluated(event.task, "|".join(map(str, event.seam.blocks)), event.seam.seam)
        case Transfer():
            return Transferred(**vars(event))
        case Preview():
            return _save_preview(folder, event)
        case Checkpoint():
            return _save_checkpoint(folder, event, keep)
        case CheckpointWritten():
            return _take_checkpoint(folder, event, keep)
        case Trained():
            return _save_model(folder, event, scene)
        case Scored():
            return _save_scores(folder, event)
        case _:
            assert_never(event)


def make_outbox(folder: RunFolder, task: TaskId, attempt: int, token: str) -> Outbox:
    """Where an attempt may leave checkpoints, without what attempts before it have left. Raises OSError."""
    place = folder.of(task)
    folder.make(place)
    remove_partial(place)
    return Outbox(place, f"{token}-{attempt}", folder.presence, token)


def tidy(folder: RunFolder, state: RunState) -> list[Record]:
    """What a driver does with checkpoints before it begins. Returns notices.

    Those of tasks that are done are removed: the driver before was killed between the record of the result
    and the removal. A damaged one is set aside, and the one before it takes its place, if that was kept.

    Raises OSError or RunError if the disk takes nothing.
    """
    notices: list[Record] = []
    for task in state.tasks.values():
        if task.status == Status.DONE:
            remove_checkpoints(folder, task.id)
        elif message := _repaired(folder, task.id):
            notices.append(Noticed(task.id, message))
    return notices


def _repaired(folder: RunFolder, task: TaskId) -> str:
    """Puts an earlier checkpoint of a task in the place of one that is damaged or gone.

    Returns what the task then continues from; "" if nothing was wrong.
    """
    last, earlier = folder.checkpoint(task), folder.earlier_checkpoints(task)
    if (_iteration(last) is not None) if last.exists() else not earlier:
        return ""
    if last.exists():
        last.replace(_aside(last))
    for path in reversed(earlier):
        if (iteration := _iteration(path)) is not None:
            path.replace(last)
            return f"its last checkpoint is damaged: it continues from that at iteration {iteration}"
    return "its last checkpoint is damaged: it starts from the beginning"


def _aside(last: Path) -> Path:
    return last.with_name(f"{last.name}.damaged")


def remove_checkpoints(folder: RunFolder, task: TaskId) -> None:
    """Removes what a task needed until it was done, and what its attempts have left. Raises OSError."""
    path = folder.checkpoint(task)
    made = path, _aside(path), folder.early(task), folder.snapshot(task)
    for file in (*made, *folder.earlier_checkpoints(task)):
        file.unlink(missing_ok=True)
    if task.stage.refines:
        folder.initial(task).unlink(missing_ok=True)
    if task.stage.in_shards:
        for seen in (folder.seen(task), folder.seen_coarse(task)):
            seen.unlink(missing_ok=True)
    remove_partial(path.parent)


class Usages:
    """What the machines do, one value of each."""

    def __init__(self, folder: RunFolder, database: Database, clock: Clock) -> None:
        self._folder, self._database, self._clock = folder, database, clock
        self._measured: dict[str, float] = {}  # Clock.monotonic() of the last measurement by node

    def keep(self, usage: Usage) -> None:
        """Stores what a machine does, unless another of its tasks has just sent it."""
        now = self._clock.monotonic()
        if now - self._measured.get(usage.node, -math.inf) < INTERVAL_S - 1:
            return
        if usage.node == socket.gethostname():  # here the disk of the run counts
            disk = shutil.disk_usage(self._folder.root)
            usage = replace(usage, disk_used=disk.used, disk_total=disk.total)
        self._database.put_usage(usage.node, asdict(usage))
        self._measured[usage.node] = now


def _save_preview(folder: RunFolder, event: Preview) -> PreviewSaved:
    path = folder.preview(event.task, event.iteration)
    folder.make(path.parent)
    write_bytes(path, event.jpeg)
    kept = sorted(int(file.stem) for file in path.parent.glob("*.jpg") if file.stem.isdecimal())
    if (gone := thinning.surplus(kept, event.iteration)) is not None:
        folder.preview(event.task, gone).unlink(missing_ok=True)
    if event.snapshot is not None:
        checkpoint.save(folder.snapshot(event.task), event.snapshot)
    return PreviewSaved(event.task, event.iteration, event.view, folder.relative(path), event.held_out)


def _save_checkpoint(folder: RunFolder, event: Checkpoint, keep: int) -> CheckpointSaved:
    path = folder.checkpoint(event.task)
    folder.make(path.parent)
    _keep_last(folder, event.task, keep)
    checkpoint.save(path, event)
    _LOG.info("%s: saved a checkpoint at iteration %d", event.task, event.iteration)
    return CheckpointSaved(event.task, event.iteration, folder.relative(path), path.stat().st_size)


def _take_checkpoint(folder: RunFolder, event: CheckpointWritten, keep: int) -> CheckpointSaved | Noticed:
    """Makes what a worker has written the checkpoint of its task, if it is whole by its size and header."""
    path = folder.checkpoint(event.task)
    written = path.with_name(event.name)
    try:
        size, iteration = written.stat().st_size, checkpoint.iteration_of(written)
    except (FileNotFoundError, checkpoint.DamagedCheckpointError):
        size = iteration = -1
    if (size, iteration) != (event.size, event.iteration):
        written.unlink(missing_ok=True)
        return Noticed(event.task, f"the checkpoint at iteration {event.iteration} was lost: it is not whole")
    _keep_last(folder, event.task, keep)
    publish(written, path)
    _LOG.info("%s: its worker saved a checkpoint at iteration %d", event.task, event.iteration)
    return CheckpointSaved(event.task, event.iteration, folder.relative(path), event.size)


def _keep_last(folder: RunFolder, task: TaskId, keep: int) -> None:
    """Gives the last checkpoint a second name before a newer one takes its place; removes surplus ones."""
    last = folder.checkpoint(task)
    if keep > 1 and last.exists() and (iteration := _iteration(last)) is not None:
        earlier = folder.earlier_checkpoint(task, iteration)
        earlier.unlink(missing_ok=True)
        try:
            earlier.hardlink_to(last)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            _LOG.warning("%s: the disk of the run has no links: only the last checkpoint is kept", task)
    for path in folder.earlier_checkpoints(task)[: -(keep - 1) or None]:
        path.unlink(missing_ok=True)


def _iteration(path: Path) -> int | None:
    """The iteration of a checkpoint; None if it is damaged. Raises RunError if it cannot be read."""
    try:
        return checkpoint.iteration_of(path)
    except checkpoint.DamagedCheckpointError:
        return None


def _save_model(folder: RunFolder, event: Trained, scene: Scene) -> ModelSaved:
    path = folder.model(event.task)
    folder.make(path.parent)
    if event.captured is not None:
        if event.task == COARSE:
            save_captured(folder, event.captured, scene)
        else:
            event.captured.save(folder.captured(event.task))
    count = len(event.gaussians)
    write_ply(path, event.gaussians, offset=scene.offset)
    size = path.stat().st_size
    return ModelSaved(event.task, folder.relative(path), count, size, event.iterations, event.seconds)


def _save_scores(folder: RunFolder, event: Scored) -> ScoresSaved:
    path = folder.shard(event.task)
    folder.make(path.parent)
    write_scores(path, event.cameras, event.scores.numpy())
    return ScoresSaved(event.task, folder.relative(path), len(event.cameras))
