"""Runs that are stopped by a limit, a signal or an empty folder, and continued. Workers are fakes."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.engine.cluster import connection
from panolog.orchestrator.runs.control import state_of
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.money.limits import Wanted
from panolog.orchestrator.runs.money.prices import PriceList
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Outcome,
    RunBegan,
    RunEnded,
    Stored,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState, ignore
from panolog.orchestrator.runs.storage.layout import OBJECTS, current
from panolog.orchestrator.runs.storage.lease import holder
from panolog.scene.stores.store import open_store
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, Progress, Stage, TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.calibrated import says
from tests.orchestrator.cli.program import call
from tests.orchestrator.cli.session.test_session import CONFIG, SETTINGS, calibrating, start
from tests.orchestrator.engine.driver.test_budget import saved
from tests.orchestrator.fakes import MACHINE, FakePool, well
from tests.orchestrator.watch.views.pages.snapshots import snapshot_of

pytestmark = pytest.mark.system

BLOCK = TaskId.block(1)


@pytest.fixture(scope="module")
def calm(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing has disturbed."""
    start(scene, root := tmp_path_factory.mktemp("runs") / "calm")
    return root


def same_bytes(ours: Path, theirs: Path) -> None:
    for name in ("coarse/model.ply", "blocks/001/model.ply", "point_cloud.ply", "eval/metrics.json"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes(), name


@pytest.fixture
def panolog(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Calls a command whose tasks run in a pool of the test; returns what it says."""

    def called(pool: FakePool, *words: object, code: int = 0) -> str:
        monkeypatch.setattr(connection, "connect", lambda *_: nullcontext(pool))
        ended = call(*words)
        assert ended.exit_code == code, ended.output
        return ended.stderr

    return called


class Lasting(FakePool):
    """The second block has a checkpoint soon, and trains until it is to stop."""

    def __init__(self) -> None:
        super().__init__(self._work, [MACHINE])

    def _work(self, spec: TaskSpec) -> Iterator[Any]:
        if not isinstance(spec, TrainSpec) or spec.task != BLOCK:
            yield from says(spec) if isinstance(spec, CalibrateSpec) else well(spec)
            return
        yield saved(spec, 1)
        while BLOCK not in self.stopped:
            yield Progress(BLOCK, 1, 2, 3.0)


def test_a_limit_delivers_what_there_is_and_without_it_the_bytes_are_the_same(
    scene: Path, calm: Path, tmp_path: Path, panolog: Callable[..., str]
) -> None:
    root = tmp_path / "run"
    prices = {"currency": "EUR", "machine": [{"name": "any", "price": 3600, "host": "*"}]}

    def interrupt(_: RunState, news: Sequence[Stored]) -> None:
        if any(isinstance(it.record, CheckpointSaved) and it.record.task == BLOCK for it in news):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wanted = Wanted(prices=PriceList.model_validate(prices))
        session.start(scene, root, CONFIG, None, interrupt, Lasting(), wanted=wanted)
    cost = state_of(root).money.used.cost
    assert cost > 0
    said = panolog(Lasting(), "resume", root, "--max-cost", cost * 1.001)  # what follows uses it up
    assert "ended early: the limit of" in said
    limited = state_of(root)
    assert (limited.outcome, limited.status(BLOCK)) == ("limited", "waiting")
    assert limited.merged is not None
    assert (limited.metrics or {})["psnr"] is not None
    reported = snapshot_of(RunFolder(root).report.read_text())["stream"]["run"]["summary"]
    assert reported["money"]["used"]["cost"] == limited.money.used.cost
    panolog(calibrating(), "resume", root)
    assert state_of(root) == limited
    panolog(calibrating(), "resume", root, "--max-cost", "none")
    assert state_of(root).outcome == "done"
    same_bytes(root, calm)


def test_a_run_in_a_store_continues_in_an_empty_folder(
    scene: Path, calm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, panolog: Callable[..., str]
) -> None:
    monkeypatch.setenv("PANOLOG_STORE_CACHE", str(tmp_path / "cache"))
    run, first, second = f"file://{tmp_path}/store", tmp_path / "first", tmp_path / "second"
    sets = [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")]
    words = ("run", scene.as_uri(), "-o", run, "--local", first, *sets)

    def interrupted(spec: TaskSpec) -> Iterator[Any]:
        if spec.task.stage is Stage.BLOCK:
            raise KeyboardInterrupt
        yield from says(spec) if isinstance(spec, CalibrateSpec) else well(spec)

    panolog(FakePool(interrupted, [MACHINE]), *words, code=130)
    shutil.rmtree(first)
    panolog(calibrating(), "resume", run, "--local", second)
    records = [stored.record for stored in read_records(RunFolder(second).database)]
    assert [record.resumed for record in records if isinstance(record, RunBegan)] == [False, True]
    same_bytes(second, calm)
    store = open_store(run)
    assert store.read("point_cloud.ply") == (calm / "point_cloud.ply").read_bytes()
    assert holder(store) == ""
    manifest = current(store)
    assert manifest is not None
    assert not any(name.endswith("checkpoint.safetensors") for name in manifest.files)
    assert set(store.list(f"{OBJECTS}/coarse/model.ply")) == {manifest.files["coarse/model.ply"].key}


def test_ctrl_c_saves_what_is_trained(scene: Path, tmp_path: Path) -> None:
    """A terminal sends it to the supervisor too, which passes it on: engine/driver/test_requests.py."""

    class Signalled(Lasting):
        def _work(self, spec: TaskSpec) -> Iterator[Any]:
            if spec.task != COARSE:
                yield from super()._work(spec)
                return
            os.kill(os.getpid(), signal.SIGINT)
            while COARSE not in self.stopped:
                yield Progress(COARSE, 1, 2, 3.0)
            assert isinstance(spec, TrainSpec)
            yield saved(spec, 1)

    root = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        session.start(scene, root, CONFIG, None, ignore, Signalled())
    records = [stored.record for stored in read_records(RunFolder(root).database)]
    assert TaskYielded(COARSE) in records
    assert records[-1] == RunEnded(Outcome.INTERRUPTED)
    assert state_of(root).task(COARSE).checkpoint == 1
