"""How many checkpoints of a task stay, and what takes the place of a damaged one."""

import errno
from pathlib import Path
from typing import cast

import pytest
import torch

from panolog.orchestrator.engine.driver import saving
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import CheckpointSaved, Noticed
from panolog.orchestrator.runs.state import RunState
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint, CheckpointWritten
from panolog.workers.tasks import COARSE
from panolog.workers.training import checkpoint
from tests.orchestrator.history import after, model

SCENE = cast(Scene, None)  # no part of a checkpoint


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path)


def save(folder: RunFolder, iteration: int, keep: int) -> None:
    event = Checkpoint(COARSE, iteration, {"x": torch.full((9,), float(iteration))})
    record = saving.save(folder, event, SCENE, keep)
    assert isinstance(record, CheckpointSaved)


def kept(folder: RunFolder) -> list[int]:
    paths = [*folder.earlier_checkpoints(COARSE), folder.checkpoint(COARSE)]
    return [checkpoint.iteration_of(path) for path in paths]


def state(*, done: bool = False) -> RunState:
    return after(CheckpointSaved(COARSE, 50, "", 1), *([model(COARSE)] if done else []))


@pytest.mark.parametrize(
    ("keep", "left"), [(1, [50]), (2, [40, 50]), (3, [30, 40, 50]), (9, [10, 20, 30, 40, 50])]
)
def test_the_last_ones_stay(folder: RunFolder, keep: int, left: list[int]) -> None:
    for iteration in range(10, 60, 10):
        save(folder, iteration, keep)
    assert kept(folder) == left
    tensors = checkpoint.load(folder.earlier_checkpoints(COARSE)[0]).tensors if keep > 1 else None
    assert tensors is None or tensors["x"][0] == left[0]


def test_those_that_workers_write_count_alike(folder: RunFolder) -> None:
    for iteration in (10, 20, 30):
        written = folder.checkpoint(COARSE).with_name(".worker.part")
        written.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.save(written, Checkpoint(COARSE, iteration, {"x": torch.zeros(9)}))
        event = CheckpointWritten(COARSE, iteration, written.name, written.stat().st_size, 0.1)
        saving.save(folder, event, SCENE, 2)
    assert kept(folder) == [20, 30]


def test_fewer_stay_when_the_setting_is_lower_and_none_when_the_task_is_done(folder: RunFolder) -> None:
    for iteration in (10, 20, 30):
        save(folder, iteration, 3)
    save(folder, 40, 1)
    assert kept(folder) == [40]
    save(folder, 50, 3)
    assert saving.tidy(folder, state(done=True)) == []
    assert list(folder.of(COARSE).iterdir()) == []


@pytest.mark.parametrize("damage", ["truncated", "empty", "missing"])
def test_a_damaged_one_gives_way_to_the_last_whole_one(folder: RunFolder, damage: str) -> None:
    for iteration in (20, 30, 40, 50):
        save(folder, iteration, 4)
    last, before = folder.checkpoint(COARSE), folder.earlier_checkpoint(COARSE, 40)
    for path in (last, before):
        content = path.read_bytes()
        path.unlink()  # the name alone: another one may have the same bytes
        if damage != "missing":
            path.write_bytes(content[: len(content) - 4 if damage == "truncated" else 0])
    (notice,) = saving.tidy(folder, state())
    assert notice == Noticed(COARSE, "its last checkpoint is damaged: it continues from that at iteration 30")
    assert checkpoint.load(last).tensors["x"][0] == 30
    assert saving.tidy(folder, state()) == []


def test_without_another_one_a_damaged_one_is_set_aside_until_the_task_is_done(folder: RunFolder) -> None:
    save(folder, 50, 1)
    folder.checkpoint(COARSE).write_bytes(b"x")
    (notice,) = saving.tidy(folder, state())
    assert notice == Noticed(COARSE, "its last checkpoint is damaged: it starts from the beginning")
    assert [path.read_bytes() for path in folder.of(COARSE).iterdir()] == [b"x"]
    assert saving.tidy(folder, state()) == []
    saving.tidy(folder, state(done=True))
    assert list(folder.of(COARSE).iterdir()) == []


def test_a_disk_without_links_keeps_the_last_one(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(error, "no")

    error = errno.EPERM
    monkeypatch.setattr(Path, "hardlink_to", refuse)
    for iteration in (10, 20):
        save(folder, iteration, 3)
    assert kept(folder) == [20]
    error = errno.ENOSPC
    with pytest.raises(OSError, match="no"):
        save(folder, 30, 3)
    assert kept(folder) == [20]  # nothing is lost
