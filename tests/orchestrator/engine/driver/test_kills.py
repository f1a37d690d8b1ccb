"""Drivers that are killed, before and after every record: the run ends with the bytes of a calm one."""

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.runs.clock import Clock
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.records import Record, Stored
from panolog.orchestrator.runs.state import Status
from tests.orchestrator.fakes import Harness

pytestmark = pytest.mark.system

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
