"""Checkpoints of tasks on a GPU: how often, through which memory, which way. The GPU is CPU tensors."""

import threading
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from panolog.scene.tensors.transfer import packed_bytes
from panolog.workers.events import Checkpoint, CheckpointWritten, Event
from panolog.workers.tasks import COARSE
from panolog.workers.training import checkpoint, checkpointing
from panolog.workers.training.checkpointing import Outbox, Saver, Staging
from panolog.workers.training.task_config import CheckpointConfig
from tests.on_device import needs_a_card
from tests.renderer.cuda.fake_cuda import Torch

ONE = {"means": torch.rand(7, 3), "views": torch.arange(7), "sky": torch.tensor(2), "none": torch.rand(0, 3)}
OTHER = {name: tensor + 1 for name, tensor in ONE.items()}


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Torch:
    fake = Torch()
    monkeypatch.setattr(checkpointing, "torch", fake)
    return fake


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    (tmp_path / "driver").write_text("token")
    return Outbox(tmp_path, "token-1", tmp_path / "driver", "token")


def state_of(tensors: Mapping[str, Tensor], iteration: int = 5) -> checkpointing.State:
    """As `Trainer.checkpoint`."""
    return lambda copied: Checkpoint(COARSE, iteration, copied(tensors))


def same(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> bool:
    return found.keys() == expected.keys() and all(torch.equal(found[n], t) for n, t in expected.items())


def test_copies_share_one_pinned_buffer_and_one_wait(cuda: Torch) -> None:
    staging = Staging()
    assert same(staging.copied(ONE), ONE)
    assert same(staging.copied(OTHER), OTHER)
    assert cuda.log.count("the host waits") == 2
    _, size = cuda.pinned
    assert size <= 2 * packed_bytes(ONE)
    larger = {"means": torch.rand(100, 3)}
    assert same(staging.copied(larger), larger)
    assert cuda.pinned == [0, size, 0, 2048]  # what was too small goes first


def test_a_worker_on_a_gpu_that_sees_the_run_folder_writes_from_pinned_memory(
    cuda: Torch, outbox: Outbox
) -> None:
    """Nothing large is an event, so nothing passes through the object store."""
    saver = Saver(CheckpointConfig(), outbox, "cuda")
    for iteration, tensors in ((5, ONE), (9, OTHER)):
        (event,) = saver.save(state_of(tensors, iteration), last=True)
        assert isinstance(event, CheckpointWritten)
        found = checkpoint.load(outbox.folder / event.name)
        assert found.iteration == iteration and same(found.tensors, tensors)
    assert (len(cuda.pinned), cuda.log.count("the host waits")) == (2, 2)  # one buffer for both


def test_training_continues_while_a_file_is_written(
    cuda: Torch, outbox: Outbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, save = threading.Event(), checkpoint.save

    def slow(path: Path, state: Checkpoint) -> None:
        assert held.wait(60)
        save(path, state)

    monkeypatch.setattr(checkpoint, "save", slow)
    saver = Saver(CheckpointConfig(every=1, interval=0, share=1), outbox, "cuda")
    assert saver.due(5)
    assert list(saver.save(state_of(ONE), last=False)) == []
    assert not saver.due(6)  # its memory is in use
    assert list(saver.finished()) == []
    held.set()
    first, last = saver.save(state_of(OTHER, 7), last=True)  # a task that ends waits for both
    for event, iteration, tensors in ((first, 5, ONE), (last, 7, OTHER)):
        assert isinstance(event, CheckpointWritten)
        found = checkpoint.load(outbox.folder / event.name)
        assert found.iteration == iteration and same(found.tensors, tensors)
    assert list(saver.finished(wait=True)) == []


def unwritable(outbox: Outbox) -> Outbox:
    return Outbox(outbox.folder / "gone", outbox.attempt, outbox.marker, outbox.token)


@pytest.mark.parametrize("where", [lambda _: None, unwritable])
def test_what_a_worker_on_a_gpu_sends_is_not_changed_by_the_next(
    cuda: Torch, outbox: Outbox, where: Callable[[Outbox], Outbox | None]
) -> None:
    saver, sent = Saver(CheckpointConfig(), where(outbox), "cuda"), list[Event]()
    for tensors in (ONE, OTHER):
        *_, event = saver.save(state_of(tensors), last=True)
        sent.append(event)
    for event, tensors in zip(sent, (ONE, OTHER), strict=True):
        assert isinstance(event, Checkpoint) and same(event.tensors, tensors)


def times(config: CheckpointConfig, device: str, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds at which it saves in five minutes of a hundred iterations a second."""
    now = [1000.0]
    monkeypatch.setattr("panolog.workers.training.checkpointing.time.monotonic", lambda: now[0])
    saver, saved = Saver(config, None, device), list[float]()
    for iteration in range(1, 30_001):
        now[0] += 0.01
        if saver.due(iteration):
            saved.append(round(now[0] - 1000, 3))
            list(saver.save(state_of(ONE), last=False))
    return saved


def test_on_a_gpu_a_minute_is_between_two_checkpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    config = CheckpointConfig(every=1000)
    tens = [10.0 * i for i in range(1, 31)]
    assert times(config, "cpu", monkeypatch) == tens
    on_gpu = [0.0, *times(config, "cuda", monkeypatch)]
    assert all(59.99 < after - before < 70.01 for before, after in pairwise(on_gpu)) and on_gpu[-1] > 230
    every = config.model_copy(update={"interval": 0.0})
    assert times(every, "cuda", monkeypatch) == tens


@needs_a_card
def test_on_a_card_a_checkpoint_has_the_values_of_its_moment(outbox: Outbox) -> None:
    saver = Saver(CheckpointConfig(), outbox, "cuda")
    there = {name: tensor.cuda() for name, tensor in ONE.items()}
    for _ in range(3):
        expected = {name: tensor.cpu() for name, tensor in there.items()}
        (event,) = saver.save(state_of(there), last=True)
        assert isinstance(event, CheckpointWritten)
        for tensor in there.values():
            tensor.add_(1)
        assert same(checkpoint.load(outbox.folder / event.name).tensors, expected)
