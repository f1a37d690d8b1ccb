"""A run.db with what failures leave in its curves: iterations that come again after each resume."""

from contextlib import closing
from pathlib import Path

from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    EvaluationSaved,
    ModelSaved,
    Outcome,
    Progressed,
    Record,
    RunBegan,
    RunEnded,
    TaskStarted,
)
from panolog.orchestrator.watch.views.queries import series
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.fakes import SetClock
from tests.orchestrator.history import begun

BLOCK = TaskId.block(0)
Curves = dict[tuple[str, str], list[tuple[int, float]]]  # by task and name: iteration and value


def progress(task: TaskId, iteration: int) -> Progressed:
    loss = 1.0 / iteration
    return Progressed(
        task, iteration, 100, 7.0, loss, 20 + loss, 3 * iteration, 1000, rates={"means": loss / 10}
    )


def attempt(task: TaskId, begin: int, step: int, end: int) -> list[Record]:
    """From a checkpoint on, with two more, and with progress at other iterations than other attempts."""
    records: list[Record] = [TaskStarted(task, 1, begin, "node", 1, "cpu", 1)]
    for iteration in range(begin + step, end + 1, step):
        records.append(progress(task, iteration))
        if iteration in (begin + 2 * step, begin + 4 * step):
            records.append(CheckpointSaved(task, iteration, "p", 1))
    return records


def parts() -> list[list[Record]]:
    """What three drivers record of a run, two of which are killed."""
    trained: list[Record] = [ModelSaved(task, "p", 1, 1, 100, 1.0) for task in (COARSE, BLOCK)]
    end: list[Record] = [EvaluationSaved("m", {"psnr": 31.5, "lpips": None}), RunEnded(Outcome.DONE)]
    again = [*attempt(BLOCK, 28, 3, 52), *attempt(BLOCK, 40, 2, 100)]
    return [
        [RunBegan("host", 1, resumed=False), *attempt(COARSE, 0, 5, 48)],  # checkpoints 10 and 20
        [
            RunBegan("host", 2, resumed=True),
            *attempt(COARSE, 20, 6, 98),
            trained[0],
            *attempt(BLOCK, 0, 7, 60),
        ],
        [RunBegan("host", 3, resumed=True), *again, trained[1], *end],
    ]


def write(root: Path, first: int = 0, until: int = 3, *, clock: SetClock | None = None) -> RunFolder:
    """Adds what some of the drivers record to the run at `root`."""
    folder = RunFolder(root)
    if not folder.info.exists():
        begun(root)
    with closing(Database(folder.database, clock or SetClock())) as database:
        for records in parts()[first:until]:
            for record in records:
                database.append([record])
    return folder


def expected(folder: RunFolder) -> Curves:
    """The curves as the dashboard shows them, with all their points."""
    found: Curves = {}
    for task in ("coarse", "block/000"):
        for name, curve in series(folder.database, task, 10**6).items():
            found[task, name] = list(zip(map(int, curve["iteration"]), curve["value"], strict=True))
    return found
