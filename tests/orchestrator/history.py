"""Records of runs, made up, run folders with them, and the state that follows from them."""

from contextlib import closing
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import SceneRef, make_info, write_info
from panolog.orchestrator.runs.records import ModelSaved, Record, RunBegan, Stored, TaskStarted
from panolog.orchestrator.runs.state import RunState, replay
from panolog.workers.tasks import TaskId

BEGAN = RunBegan("host", 1, resumed=False)
AGAIN = RunBegan("host", 2, resumed=True)


def begun(
    root: Path, *records: Record, scene: Path | str = "/gone", fingerprint: str = "f", **config: Any
) -> RunFolder:
    """A run folder with its settings, of a scene that is gone, and with that history, if there is any."""
    folder, settings = RunFolder(root), RunConfig(**{"width": 64, **config})
    root.mkdir(parents=True, exist_ok=True)
    write_info(folder, make_info(SceneRef(path=str(scene), fingerprint=fingerprint), settings))
    if records:
        append(folder, *records)
    return folder


def append(folder: RunFolder, *records: Record) -> None:
    """What a driver does with its records."""
    with closing(Database(folder.database)) as database:
        database.append(records)


def started(
    task: TaskId, iteration: int = 0, *, attempt: int = 1, node: str = "node", place: str = ""
) -> TaskStarted:
    """Args: iteration, of the checkpoint; node, its host and its id; place, its kind."""
    return TaskStarted(task, attempt, iteration, node, 7, "cpu", 1, place, node_id=node)


def model(task: TaskId, iterations: int = 30, seconds: float = 1.5) -> ModelSaved:
    """The record of a model with ten Gaussians."""
    return ModelSaved(task, f"{task}/model.ply", 10, 100, iterations, seconds)


def after(*records: Record) -> RunState:
    """The state after records, one a second, the first at 1."""
    return replay(Stored(i, float(i), record) for i, record in enumerate(records, 1))
