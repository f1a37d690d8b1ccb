"""A run that is cleaned and damaged between its drivers ends with the same bytes, and stays readable."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.commands import session
from panolog.orchestrator.driver.local_pool import local_pool
from panolog.orchestrator.run.config import load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import CheckpointSaved, Noticed, Stored
from panolog.orchestrator.run.state import OnChange, RunState, ignore, replay
from panolog.orchestrator.run.store import read_milestones
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE, TaskId

pytestmark = pytest.mark.system
SETTINGS = ("sky.count=100", "checkpoint.every=10", "checkpoint.share=1", "width=64", "densify.start=10")
KEPT = ("retention.checkpoints=3", "retention.models=false")
FLAGS = {"iterations": 50, "device": "cpu", "blocks": "2x1x1"}


def panolog(*words: object) -> str:
    result = CliRunner().invoke(app.app, list(map(str, words)))
    assert result.exit_code == 0, result.stderr
    return result.stdout


def stop_at(task: TaskId, checkpoints: int) -> OnChange:
    """A callback that ends the driver at so many checkpoints of a task."""
    seen: list[int] = []

    def show(_: RunState, news: Sequence[Stored]) -> None:
        seen.extend(it.id for it in news if isinstance(it.record, CheckpointSaved) and it.record.task == task)
        if len(seen) >= checkpoints:
            seen.clear()
            raise KeyboardInterrupt

    return show


def test_same_bytes_whatever_was_removed_in_between(tmp_path: Path) -> None:
    scene = make_town(tmp_path / "town", panoramas=9, width=64, points=300)
    calm, folder = RunFolder(tmp_path / "calm"), RunFolder(tmp_path / "run")
    with local_pool() as pool:
        session.start(scene, calm.root, load_config(None, SETTINGS, FLAGS), None, ignore, pool)
    assert calm.model(TaskId.block(0)).exists()
    with local_pool() as pool, pytest.raises(KeyboardInterrupt):
        config = load_config(None, (*SETTINGS, *KEPT), FLAGS)
        session.start(scene, folder.root, config, None, stop_at(COARSE, 3), pool)
    assert len(folder.earlier_checkpoints(COARSE)) >= 2
    panolog("clean", folder.root, "--blocks", "--keep-checkpoints", 2)
    assert len(folder.earlier_checkpoints(COARSE)) == 1
    last = folder.checkpoint(COARSE)
    last.rename(last.with_name("damaged"))  # the bytes of a name that another one may share stay
    last.write_bytes(b"damaged")
    with local_pool() as pool, pytest.raises(KeyboardInterrupt):
        session.resume(folder.root, None, stop_at(TaskId.block(0), 2), pool)
    panolog("clean", folder.root, "--blocks")
    with local_pool() as pool:
        state = session.resume(folder.root, None, ignore, pool)
    notices = [notice.message for notice in state.notices if isinstance(notice, Noticed)]
    assert any(notice.startswith("its last checkpoint is damaged: it continues from") for notice in notices)
    assert folder.point_cloud.read_bytes() == calm.point_cloud.read_bytes()
    models = [folder.model(TaskId.block(number)) for number in range(2)]
    assert not any(path.exists() for path in models)  # its settings keep none
    panolog("clean", calm.root, "--blocks")
    assert not calm.model(TaskId.block(0)).exists()
    for run in (folder, calm):
        still_readable(run, tmp_path / f"{run.root.name}.spz")


def still_readable(run: RunFolder, exported: Path) -> None:
    assert json.loads(panolog("status", run.root, "--json"))["status"] == "done"
    panolog("report", run.root, "-o", exported.with_suffix(".html"))
    panolog("export", run.root, "-o", exported)
    panolog("partition", run.root, "--tau", "0.5", "--json")
    with local_pool() as pool:
        assert session.resume(run.root, None, ignore, pool).outcome == "done"
    state = replay(read_milestones(run.database))
    assert sum("the models of the parts were removed" in it.message for it in state.notices) == 1
    result = CliRunner().invoke(
        app.app, ["view", str(run.root), "--task", "block/001", "-o", str(exported.parent / "x")]
    )
    assert result.exit_code == 2
    assert "the model of block/001 was removed after the merge" in result.stderr
