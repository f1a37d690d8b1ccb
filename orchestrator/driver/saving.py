"""From what workers say to what the run folder holds: an event's files first, then the record of them."""

from collections.abc import Callable
from typing import Any

import numpy as np

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


def save(folder: RunFolder, event: Event) -> Record:
    """Puts what an event carries into the run folder, atomically, and returns the record of it.

    Raises OSError or RunError if the disk does not take it.
    """
    return _SAVE[type(event)](folder, event)


def _save_preview(folder: RunFolder, event: Preview) -> PreviewSaved:
    path = folder.of(event.task) / "previews" / f"{event.iteration:06d}.jpg"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, event.jpeg)
    return PreviewSaved(event.task, event.iteration, event.view, folder.relative(path))


def _save_checkpoint(folder: RunFolder, event: Checkpoint) -> CheckpointSaved:
    path = folder.checkpoint(event.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.save(path, event)
    return CheckpointSaved(event.task, event.iteration, folder.relative(path), path.stat().st_size)


def _save_model(folder: RunFolder, event: Trained) -> ModelSaved:
    path = folder.model(event.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    count = len(event.gaussians)
    write_ply(path, event.gaussians)
    size = path.stat().st_size
    return ModelSaved(event.task, folder.relative(path), count, size, event.iterations, event.seconds)


def _save_scores(folder: RunFolder, event: Scored) -> ScoresSaved:
    path = folder.shard(event.task)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(file, cameras=np.array(event.cameras, np.int64), scores=event.scores.numpy())
    return ScoresSaved(event.task, folder.relative(path), len(event.cameras))


_SAVE: dict[type[Event], Callable[[RunFolder, Any], Record]] = {
    Progress: lambda _, event: Progressed(**vars(event)),
    Notice: lambda _, event: Noticed(event.task, event.message),
    Evaluated: lambda _, event: ViewEvaluated(event.task, event.view, event.metrics),
    Transfer: lambda _, event: Transferred(**vars(event)),
    Preview: _save_preview,
    Checkpoint: _save_checkpoint,
    Trained: _save_model,
    Scored: _save_scores,
}
