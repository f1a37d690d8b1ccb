"""Checkpoint files are whole or refused."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from panolog.scene.errors import RunError
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint
from panolog.workers.tasks import TaskId
from panolog.workers.training.checkpoint import DamagedCheckpointError, load, name_of, save
from panolog.workers.training.trainer import train
from tests.workers.trainings import coarse_of, notices, same, trained


@pytest.fixture
def checkpoint() -> Checkpoint:
    return Checkpoint(TaskId.block(7), 123, {"means": torch.rand(5, 3), "sky": torch.tensor(2)})


def test_a_checkpoint_reads_back(tmp_path: Path, checkpoint: Checkpoint) -> None:
    save(tmp_path / "a.safetensors", checkpoint)
    back = load(tmp_path / "a.safetensors")
    assert (back.task, back.iteration) == (TaskId.block(7), 123)
    assert all(torch.equal(back.tensors[name], tensor) for name, tensor in checkpoint.tensors.items())
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


@pytest.mark.parametrize("length", [0, 7, 60, -1])
def test_a_truncated_file_is_refused(tmp_path: Path, checkpoint: Checkpoint, length: int) -> None:
    path = tmp_path / "a.safetensors"
    save(path, checkpoint)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(RunError, match=r"a\.safetensors is not a whole checkpoint"):
        load(path)


def test_other_bytes_than_were_written_are_refused(tmp_path: Path, checkpoint: Checkpoint) -> None:
    """A bit that a disk or a network has changed is in no header."""
    path = tmp_path / "a.safetensors"
    save(path, checkpoint)
    content = bytearray(path.read_bytes())
    content[-6] ^= 1
    path.write_bytes(content)
    assert name_of(path) == (TaskId.block(7), 123)
    with pytest.raises(DamagedCheckpointError, match="not those that were written"):
        load(path)


def test_a_task_starts_from_the_beginning_without_a_whole_checkpoint(scene: Scene) -> None:
    coarse = coarse_of(scene)

    class Damaged:
        def load(self) -> Checkpoint:
            raise DamagedCheckpointError("c.safetensors is not a whole checkpoint (why)")

    events = list(train(replace(coarse, checkpoint=Damaged())))
    (notice,) = notices(events)
    assert notice == "c.safetensors is not a whole checkpoint (why): it starts from the beginning"
    assert same(trained(events), trained(list(train(coarse))))


def test_what_fails_half_way_leaves_the_file_before(
    tmp_path: Path, checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_tensors: object, path: Path, _metadata: object) -> None:
        path.write_bytes(before[:60])
        raise OSError("No space left on device")

    path = tmp_path / "a.safetensors"
    save(path, checkpoint)
    before = path.read_bytes()
    monkeypatch.setattr("panolog.workers.training.checkpoint.save_file", full)
    with pytest.raises(RunError, match=r"cannot write.*No space left"):
        save(path, checkpoint)
    assert path.read_bytes() == before and [*tmp_path.iterdir()] == [path]


def test_a_missing_file_and_a_missing_folder_are_run_errors(tmp_path: Path, checkpoint: Checkpoint) -> None:
    with pytest.raises(RunError):
        load(tmp_path / "none.safetensors")
    with pytest.raises(RunError, match="cannot write"):
        save(tmp_path / "none" / "a.safetensors", checkpoint)
