"""From the events of workers to the content of the run folder: an event's files first, then its record."""

import logging

import numpy as np
from typing_extensions import assert_never

from panolog.orchestrator.run import thinning
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    ModelSaved,
    Noticed,
    PreviewSaved,
    Progressed,
    Record,
    ScoresSaved,
    Transferred,
    ViewEvaluated,
)
from panolog.scene.files import atomic, write_bytes
from panolog.scene.model import NO_OFFSET, Vector
from panolog.scene.ply import write_ply
from panolog.workers.events import (
    Checkpoint,
    Evaluated,
    Event,
    Notice,
    Preview,
    Progress,
    Scored,
    Trained,
    Transfer,
)
from panolog.workers.training import checkpoint

_LOG = logging.getLogger(__name__)


def save(folder: RunFolder, event: Event, offset: Vector = NO_OFFSET) -> Record:
    """Puts what an event carries into the run folder, atomically, and returns the record of it.

    Args: offset, `Scene.offset`, which a PLY notes.

    Raises OSError or RunError if the disk does not take it.
    """
    match event:
        case Progress():
            return Progressed(**vars(event))
        case Notice():
            return Noticed(event.task, event.message)
        case Evaluated():
            return ViewEvaluated(event.task, event.view, event.metrics)
        case Transfer():
            return Transferred(event.task, event.received, event.sent)
        case Preview():
            return _save_preview(folder, event)
        case Checkpoint():
            return _save_checkpoint(folder, event)
        case Trained():
            return _save_model(folder, event, offset)
        case Scored():
            return _save_scores(folder, event)
        case _:
            assert_never(event)


def _save_preview(folder: RunFolder, event: Preview) -> PreviewSaved:
    path = folder.preview(event.task, event.iteration)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, event.jpeg)
    kept = sorted(int(file.stem) for file in path.parent.glob("*.jpg") if file.stem.isdecimal())
    if (gone := thinning.surplus(kept, event.iteration)) is not None:
        folder.preview(event.task, gone).unlink(missing_ok=True)
    return PreviewSaved(event.task, event.iteration, event.view, folder.relative(path))


def _save_checkpoint(folder: RunFolder, event: Checkpoint) -> CheckpointSaved:
    path = folder.checkpoint(event.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.save(path, event)
    _LOG.info("%s: saved a checkpoint at iteration %d", event.task, event.iteration)
    return CheckpointSaved(event.task, event.iteration, folder.relative(path), path.stat().st_size)


def _save_model(folder: RunFolder, event: Trained, offset: Vector) -> ModelSaved:
    path = folder.model(event.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    count = len(event.gaussians)
    write_ply(path, event.gaussians, offset=offset)
    size = path.stat().st_size
    return ModelSaved(event.task, folder.relative(path), count, size, event.iterations, event.seconds)


def _save_scores(folder: RunFolder, event: Scored) -> ScoresSaved:
    path = folder.shard(event.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(file, cameras=np.array(event.cameras, np.int64), scores=event.scores.numpy())
    return ScoresSaved(event.task, folder.relative(path), len(event.cameras))
