"""A run whose disk is full or out of reach for a while: it waits, says so, and continues by itself."""

import errno
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.orchestrator.engine.driver import driver as driver_module
from panolog.orchestrator.engine.driver import own_results, saving
from panolog.orchestrator.engine.stages import evaluation
from panolog.orchestrator.runs import control, presence
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.presence import why_waiting
from panolog.orchestrator.runs.records import ModelSaved, Record, RunContinued, RunWaiting
from panolog.orchestrator.runs.state import RunState
from panolog.scene.errors import RunError
from panolog.workers.events import Checkpoint, Event, Preview, Trained
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training import checkpoint
from tests.orchestrator.fakes import Harness, begins

FULL = OSError(errno.ENOSPC, "No space left on device")
QUICK: dict[str, Any] = {"disk": {"retry": 0.01}}
Action = Callable[..., Any]


class Refusing:
    def __init__(self, action: Action, error: Exception, times: int, when: Callable[..., bool] | None = None):
        self.action, self.error, self.left = action, error, times
        self.when = when or (lambda *_: True)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if self.left and self.when(*arguments):
            self.left -= 1
            raise self.error
        return self.action(*arguments, **named)


@pytest.fixture
def quick(tmp_path: Path) -> Harness:
    return Harness(tmp_path, **QUICK)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    harness = Harness(tmp_path_factory.mktemp("undisturbed"))
    harness.drive()
    return harness.folder.point_cloud.read_bytes()


@pytest.mark.parametrize(
    ("kind", "number"), [(Checkpoint, errno.ENOSPC), (Trained, errno.EIO), (Preview, errno.ESTALE)]
)
def test_a_disk_that_takes_nothing_for_a_while_delays_the_run_and_nothing_else(
    quick: Harness, undisturbed: bytes, monkeypatch: pytest.MonkeyPatch, kind: type, number: int
) -> None:
    error = OSError(number, "for a while")
    save = Refusing(saving.save, error, 3, lambda _, event, *__: isinstance(event, kind))
    monkeypatch.setattr(driver_module, "save", save)
    assert quick.drive(begins(COARSE, Preview(COARSE, 1, "a.jpg", b"picture"))).outcome == "done"
    assert save.left == 0
    assert quick.folder.point_cloud.read_bytes() == undisturbed
    assert len(quick.records(RunContinued)) == len({w.reason for w in quick.records(RunWaiting)}) == 1
    assert quick.state.waiting == presence.waiting(quick.folder.presence) == ""


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (own_results, "decide_plan"),
        (own_results, "write_plan"),
        (own_results, "merge_run"),
        (evaluation, "write_json"),
    ],
)
def test_what_the_driver_makes_itself_is_made_again(
    quick: Harness, undisturbed: bytes, monkeypatch: pytest.MonkeyPatch, module: Any, name: str
) -> None:
    monkeypatch.setattr(module, name, Refusing(getattr(module, name), FULL, 2))
    assert quick.drive().outcome == "done"
    assert quick.folder.point_cloud.read_bytes() == undisturbed
    assert quick.folder.metrics.is_file()
    assert len(quick.records(RunContinued)) == 1


@pytest.mark.parametrize("text", ["database or disk is full", "disk I/O error"])
def test_a_database_without_room_keeps_no_record_and_loses_none(
    quick: Harness, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    said, left, store = list[str](), [6], Database.store

    def refuses(self: Database, records: list[tuple[float, Record]], **options: float) -> Any:
        said.append(presence.waiting(quick.folder.presence))
        if left[0] and any(isinstance(record, ModelSaved | RunWaiting) for _, record in records):
            left[0] -= 1
            raise sqlite3.OperationalError(text)
        return store(self, records, **options)

    monkeypatch.setattr(Database, "store", refuses)
    assert quick.drive().outcome == "done"
    assert {str(m.task) for m in quick.records(ModelSaved)} == {"coarse", "block/000", "block/001"}
    assert not quick.records(RunWaiting)
    # In the small file, which `status` reads; of a run in a deep folder it has the beginning.
    assert any(line.startswith(("disk full, waiting", "waiting for the disk of")) for line in said)
    assert presence.waiting(quick.folder.presence) == ""


def test_what_landed_is_recorded_before_the_run_ends(quick: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    """The write of one block fails for good while another block's is done in the same turn."""

    def of_block(_: object, event: Event, *__: object) -> bool:
        return isinstance(event, Trained) and event.task == TaskId.block(0)

    error = PermissionError(13, "Permission denied")
    monkeypatch.setattr(driver_module, "save", Refusing(saving.save, error, 1, of_block))
    with pytest.raises(RunError, match="Permission denied"):
        quick.drive()
    landed = {m.task for m in quick.records(ModelSaved)}
    on_disk = {task for task in (COARSE, TaskId.block(1)) if quick.folder.model(task).is_file()}
    assert landed == on_disk


def request(harness: Harness, text: str) -> None:
    harness.folder.control.mkdir(exist_ok=True)
    (harness.folder.control / "1.json").write_text(text)


@pytest.mark.parametrize("how", ["signal", "request"])
def test_a_run_that_waits_can_be_stopped(quick: Harness, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    def full(*_: Any) -> Record:
        quick.stop.signal() if how == "signal" else request(quick, '{"action": "stop"}')
        raise FULL

    monkeypatch.setattr(own_results, "merge_run", full)
    with pytest.raises(KeyboardInterrupt):
        quick.drive()
    monkeypatch.undo()
    assert quick.drive(resumed=True).outcome == "done"


def test_a_request_during_the_wait_is_carried_out_after_it(
    quick: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any) -> Any:
        if quick.folder.control.is_dir():
            return saving.save(*arguments)
        request(quick, '{"action": "retry", "block": 0}')
        raise FULL

    monkeypatch.setattr(driver_module, "save", full)
    assert quick.drive().outcome == "done"
    assert any("retry block 0" in notice.message for notice in quick.state.notices)
    assert not list(quick.folder.control.iterdir())
    assert control.take(quick.folder) == []


def test_reasons_say_what_to_do(tmp_path: Path) -> None:
    full = why_waiting(FULL, tmp_path, 2**60)
    assert full.startswith("disk full, waiting: free ") and "GiB" in full and "stop the run" in full
    away = why_waiting(OSError(errno.EIO, "x"), tmp_path)
    assert "Input/output error" in away
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EROFS):
        assert why_waiting(OSError(number, "x"), tmp_path)
    for number in (errno.ENOENT, errno.EROFS):  # the latter is what SQLite reports
        assert "which is gone: put it back" in why_waiting(OSError(number, "x"), tmp_path / "gone")
    assert why_waiting(FileNotFoundError(errno.ENOENT, "no"), tmp_path) == ""
    assert why_waiting(ValueError("no"), tmp_path) == ""
    assert why_waiting(PermissionError(errno.EACCES, "no"), tmp_path) == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full of Linux")
def test_a_checkpoint_on_a_full_device_has_its_error_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fills(_tensors: Any, path: Path, _metadata: Any) -> None:
        path.write_bytes(b"")
        with open("/dev/full", "wb", buffering=0) as file:  # noqa: PTH123
            file.write(b"x")

    monkeypatch.setattr(checkpoint, "save_file", fills)
    with pytest.raises(RunError) as raised:
        checkpoint.save(tmp_path / "c", Checkpoint(COARSE, 1, {"x": torch.zeros(1)}))
    assert why_waiting(raised.value, tmp_path).startswith("disk full")


def on_a_small_disk(root: Path) -> None:
    """A run whose disk has 200 kB, less than its models and its database, until it waits."""
    harness, ballast = Harness(root, **QUICK), root / "ballast"
    ballast.write_bytes(bytes(shutil.disk_usage(root).free - 200_000))

    def free(state: RunState, _: object) -> None:
        if state.waiting:
            ballast.unlink(missing_ok=True)

    assert harness.drive(on_change=free).outcome == "done"
    assert harness.records(RunContinued) and not ballast.exists()


@pytest.mark.nightly
def test_a_real_disk_that_is_full_and_then_freed(tmp_path: Path) -> None:
    """A tmpfs of a few megabytes in a namespace of its own."""
    command = 'mount -t tmpfs -o size=8m tmpfs $1 && exec $2 -c "$3"'
    arguments = ["unshare", "-rm", "sh", "-c", command, "sh", str(tmp_path), sys.executable]
    probe = subprocess.run([*arguments, "pass"], capture_output=True, check=False)
    if probe.returncode:
        pytest.skip(f"needs user namespaces: {probe.stderr.decode().strip()}")
    program = f"from pathlib import Path; from {__name__} import *; on_a_small_disk(Path({str(tmp_path)!r}))"
    done = subprocess.run([*arguments, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
