"""Workers and drivers that are killed, at every stage: the run ends with the bytes of a calm one."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.driver.attempts import WorkerSpec
from panolog.orchestrator.driver.driver import Hooks
from panolog.orchestrator.driver.local_pool import LocalPool, local_pool
from panolog.orchestrator.run.clock import Clock
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Merged,
    Record,
    Stored,
    TaskFailed,
    TaskStarted,
    ViewEvaluated,
)
from panolog.orchestrator.run.state import RunState, Status
from panolog.orchestrator.run.store import Database
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.fakes import Harness
from tests.orchestrator.scripted import stalling

pytestmark = pytest.mark.system

SHARD, BLOCK = TaskId.shard(0), TaskId.block(0)
SAVED = 4  # iteration of the checkpoint of each task that trains
REAL: dict[str, Any] = {
    "iterations": 6,
    "sky": {"count": 20},
    "partition": {"min_cameras": 1},
    "checkpoint": {"every": SAVED, "share": 1.0},
}
ALL_STAGES: dict[str, Any] = {
    "districts": 2,
    "overlap": 0.1,
    "partition": {"min_cameras": 2, "rho_tri": 0.1},
    "passes": {"round": 0.5, "repair": 0.25, "reach": 0.5},
    "stage2": {"exterior": "frozen", "detail": 2.0},
}
Moment = Callable[[Sequence[Record]], str]


@dataclass
class Copies:
    """Copies of a run folder: what a driver leaves that is killed at a moment."""

    folder: Path  # that gets the copies
    moment: Moment  # the name of one at which records are stored; "" = no copy
    made: list[Path] = field(default_factory=list)
    content: object = None  # of the newest one

    def database(self, path: Path, clock: Clock) -> Database:
        """The database of a run of which copies are made."""
        copies = self

        class Copied(Database):
            def store(self, records: Sequence[tuple[float, Record]], **options: float) -> list[Stored]:
                name = copies.moment([record for _, record in records])
                copies.make(path.parent, name)
                stored = super().store(records, **options)
                copies.make(path.parent, name, recorded=True)
                return stored

        return Copied(path, clock)

    def make(self, root: Path, name: str, *, recorded: bool = False) -> None:
        """Copies a run folder that has changed. Args: recorded, whether its database has, too."""
        content = contents(root)
        if name and (recorded or content != self.content):
            self.made.append(self.folder / f"{len(self.made):03d} {name}")
            with suppress(shutil.Error):  # a thread has renamed what it has written
                shutil.copytree(root, self.made[-1], ignore=shutil.ignore_patterns("*.part"))
        self.content = content


def contents(root: Path) -> dict[str, bytes]:
    """All files of a run but its history, and what says which driver is at work."""
    files = (path for path in root.rglob("*") if path.is_file() and path.suffix != ".part")
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in files
        if not path.name.startswith(("run.db", "driver"))
    }


def always(_: Sequence[Record]) -> str:
    return "any"


def landed(records: Sequence[Record]) -> str:
    """Where something large was written, which is not recorded yet."""
    names = [type(record).__name__ for record in records if hasattr(record, "path")]
    return "" if set(names) <= {"CheckpointSaved", "PreviewSaved"} else names[0]


@pytest.mark.parametrize(
    ("settings", "moment"), [({}, always), (ALL_STAGES, landed)], ids=["usual stages", "all stages"]
)
def test_a_driver_may_be_killed_before_and_after_every_record(
    tmp_path: Path, settings: dict[str, Any], moment: Moment
) -> None:
    harness, copies = Harness(tmp_path, **settings), Copies(tmp_path / "copies", moment)
    harness.job = replace(harness.job, scene=replace(harness.job.scene, test=(0, 1, 2, 3, 4)))
    harness.drive(database=copies.database)
    expected = contents(harness.folder.root)
    assert len(copies.made) > 20
    for root in copies.made:
        killed = harness.at(root)
        done = {task for task, state in killed.state.tasks.items() if state.status == Status.DONE}
        assert killed.drive(resumed=True).outcome == "done"
        assert done.isdisjoint(killed.tasks), root
        found = contents(root)
        assert found.keys() == expected.keys(), root
        assert [name for name in found if found[name] != expected[name]] == [], root


# With workers that train


@pytest.fixture(scope="module")
def pool() -> Iterator[LocalPool]:
    with local_pool() as pool:
        yield pool


def saved_or_merged(records: Sequence[Record]) -> str:
    """The moments at which the driver is killed."""
    for record in records:
        if isinstance(record, CheckpointSaved):
            return str(record.task).replace("/", " ")
        if isinstance(record, Merged):
            return "merge"
    return ""


@pytest.fixture(scope="module")
def calm(pool: LocalPool, tmp_path_factory: pytest.TempPathFactory) -> tuple[Harness, list[Path]]:
    """A run that is left alone, and what drivers of it leave that are killed."""
    folder = tmp_path_factory.mktemp("calm")
    harness, copies = Harness(folder, **REAL), Copies(folder / "copies", saved_or_merged)
    harness.drive(pool=pool, database=copies.database)
    return harness, copies.made


def test_drivers_are_killed(calm: tuple[Harness, list[Path]], pool: LocalPool) -> None:
    harness, copies = calm
    expected, kinds = contents(harness.folder.root), set[str]()
    for root in copies:
        kinds.add(root.name[4:])
        killed = harness.at(root)
        assert killed.drive(pool=pool, resumed=True).outcome == "done"
        assert models(killed) == models(harness), root
        assert contents(root).keys() == expected.keys()
    assert len(kinds) > len({"coarse", "merge"} & kinds) == 2  # and blocks


def models(harness: Harness) -> dict[str, bytes]:
    """What training and evaluation have made."""
    return {
        name: data for name, data in contents(harness.folder.root).items() if name[-4:] in (".ply", "json")
    }


def test_every_worker_is_killed(calm: tuple[Harness, list[Path]], pool: LocalPool, tmp_path: Path) -> None:
    """Workers that train are killed once they have saved a checkpoint, and do nothing between the two."""
    harness, _ = calm
    killed, left = harness.at(tmp_path / "run"), {COARSE, SHARD, BLOCK, EVAL}
    workers: dict[TaskId, int] = {}

    def stall(spec: WorkerSpec) -> TaskSpec:
        return stalling(spec) if spec.task in left else spec

    def kill(_: RunState, news: Sequence[Stored]) -> None:
        for record in (stored.record for stored in news):
            match record:
                case TaskStarted(task, pid=pid):
                    workers[task] = pid
                    begun = task == SHARD
                case CheckpointSaved(task) | ViewEvaluated(task):
                    begun = True
                case _:
                    continue
            if begun and task in left:
                left.remove(task)
                os.kill(workers[task], signal.SIGKILL)

    assert killed.drive(pool=pool, hooks=Hooks(on_start=stall), on_change=kill).outcome == "done"
    assert not left
    assert {failed.task for failed in killed.records(TaskFailed)} == {COARSE, SHARD, BLOCK, EVAL}
    again = {record.task: record.iteration for record in killed.records(TaskStarted) if record.attempt == 2}
    assert again == {COARSE: SAVED, SHARD: 0, BLOCK: SAVED, EVAL: 0}
    assert models(killed) == models(harness)
