"""Records of runs, made up, and the state that follows from them."""

from panolog.orchestrator.runs.records import ModelSaved, Record, RunBegan, Stored, TaskStarted
from panolog.orchestrator.runs.state import RunState, replay
from panolog.workers.tasks import TaskId

BEGAN = RunBegan("host", 1, resumed=False)
AGAIN = RunBegan("host", 2, resumed=True)


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
