"""A run exists from its first second, and one that is refused leaves nothing."""

import errno
import json
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path
from shutil import copytree
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.orchestrator.cli.session import preparing, session
from panolog.orchestrator.runs import folder as run_folder
from panolog.orchestrator.runs import info as run_info
from panolog.orchestrator.runs.config import RunConfig, load_config
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import RunInfo, own_code, read_info
from panolog.orchestrator.runs.records import (
    Noticed,
    Preparing,
    PreviewSaved,
    RunContinued,
    RunEnded,
    RunWaiting,
)
from panolog.orchestrator.runs.state import ignore
from panolog.orchestrator.watch.views.plan_map import read_points
from panolog.scene.errors import ClusterLostError, InputError, RunError, SceneError
from panolog.scene.read import read_scene
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.events import Calibration, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE
from tests.orchestrator.calibrated import says
from tests.orchestrator.cli.program import call, shown
from tests.orchestrator.fakes import DIED, MACHINE, CrashError, FakePool, well

pytestmark = pytest.mark.system

SETTINGS = {"width": 64, "iterations": 2, "blocks": "2x1x1", "sky.count": 2}
CONFIG = load_config(flags=SETTINGS)


def calibrating(action: Callable[[], object] = ignore) -> FakePool:
    """A pool that does something when the calibration begins."""

    def work(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if isinstance(spec, CalibrateSpec):
            action()
        yield from says(spec) if isinstance(spec, CalibrateSpec) else well(spec)

    return FakePool(work, [MACHINE])


def start(scene: Path, root: Path, action: Callable[[], object] = ignore, config: RunConfig = CONFIG) -> None:
    session.start(scene, root, config, None, ignore, calibrating(action))


def resume(root: Path, action: Callable[[], object] = ignore) -> None:
    session.resume(root, None, ignore, calibrating(action))


def status(root: Path) -> Any:
    return shown("status", root)


@pytest.fixture(scope="module")
def calm(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run; next to it is what a driver would have left that was killed in its preflight."""
    root = tmp_path_factory.mktemp("runs") / "calm"
    start(scene, root, lambda: copytree(root, root.with_name("killed")))
    return root


@pytest.fixture
def killed(calm: Path, tmp_path: Path) -> Path:
    """What a driver leaves that is killed in its preflight."""
    return copytree(calm.with_name("killed"), tmp_path / "my killed run")


def test_status_shows_a_run_before_its_preflight_is_over(scene: Path, tmp_path: Path) -> None:
    root, seen = tmp_path / "run", list[dict[str, Any]]()
    start(scene, root, lambda: seen.append(status(root)))
    (found,) = seen
    assert (found["status"], found["stage"], found["step"]) == ("running", "calibrate", "calibrating")
    assert (found["width"], found["progress"]) == (64, 0)
    done = status(root)
    assert (done["status"], done["stage"], done["step"], done["resume"]) == ("done", "done", None, None)
    assert read_info(RunFolder(root)).config.device == "cpu"
    records = [stored.record for stored in read_records(RunFolder(root).database)]
    steps = [record.step for record in records if isinstance(record, Preparing)]
    assert steps == ["checking panoramas", "measuring exposures", "calibrating", "starting workers"]
    first = next(record for record in records if isinstance(record, Preparing | PreviewSaved))
    assert isinstance(first, PreviewSaved) and (first.task, first.iteration) == (COARSE, 0)
    assert (root / first.path).is_file()


def test_who_sees_a_run_of_a_scene_sees_the_place(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the driver was killed just before run.json was there."""
    written: list[bool] = []
    folder, write_info = RunFolder(tmp_path / "run"), run_info.write_info

    def write(folder: RunFolder, info: RunInfo) -> None:
        written.append(folder.outline.exists())
        write_info(folder, info)

    folder.outline.parent.mkdir(parents=True)
    folder.outline_points.write_text("half")
    with pytest.raises(InputError, match="is not empty and not a run"):
        start(scene, folder.root)
    folder.lock.touch()
    monkeypatch.setattr(run_info, "write_info", write)
    start(scene, folder.root)
    assert written and all(written)
    assert len(read_points(folder.outline_points))


def test_a_run_killed_in_its_preflight_resumes_to_the_same_bytes(killed: Path, calm: Path) -> None:
    found = status(killed)
    assert (found["status"], found["label"], found["stage"]) == ("stopped", "driver lost", "calibrate")
    assert "was killed or has crashed" in str(found["reason"])
    assert found["resume"] == f"panolog resume '{killed}'"
    resume(killed)
    whole, resumed = RunFolder(calm), RunFolder(killed)
    assert resumed.point_cloud.read_bytes() == whole.point_cloud.read_bytes()
    assert resumed.preflight.exists()
    assert read_info(resumed).config == read_info(whole).config


def test_a_new_run_may_take_the_place_of_one_killed_in_its_preflight(killed: Path, scene: Path) -> None:
    other = CONFIG.model_copy(update={"seed": 7})
    start(scene, killed, config=other)
    assert read_info(RunFolder(killed)).seed == 7
    with pytest.raises(InputError, match="holds a run of this scene; use `panolog resume '"):
        start(scene, killed, config=other)


def fails(error: BaseException) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


@pytest.mark.parametrize("error", [InputError("a.jpg is truncated"), KeyboardInterrupt()], ids=type)
def test_a_run_that_does_not_start_leaves_no_trace(scene: Path, tmp_path: Path, error: BaseException) -> None:
    (tmp_path / "empty").mkdir()
    for root in (tmp_path / "a" / "b", tmp_path / "empty"):
        with pytest.raises(type(error)):
            start(scene, root, fails(error))
    assert not (tmp_path / "a").exists()
    assert list((tmp_path / "empty").iterdir()) == []


def test_a_disk_that_is_full_in_the_preflight_is_waited_for(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, write = tmp_path / "run", run_folder.write_json
    errors = [OSError(errno.ENOSPC, "No space left on device")] * 2

    def write_json(path: Path, content: Any) -> None:
        if path == RunFolder(root).preflight and errors:
            raise errors.pop()
        write(path, content)

    monkeypatch.setattr(run_folder, "write_json", write_json)
    start(scene, root, config=load_config(flags={**SETTINGS, "disk.retry": 0.01}))
    records = [stored.record for stored in read_records(RunFolder(root).database)]
    assert [type(record) for record in records if isinstance(record, RunWaiting | RunContinued)] == [
        RunWaiting,
        RunContinued,
    ]
    assert RunFolder(root).point_cloud.exists()


def test_a_folder_that_is_gone_in_the_preflight_is_waited_for(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, away, write, times = tmp_path / "run", tmp_path / "away", run_folder.write_json, iter((1, 2))

    def write_json(path: Path, content: Any) -> None:
        if path == RunFolder(root).preflight and (time := next(times, 0)):
            assert not (time == 2 and root.exists())  # nothing has taken its place
            (root if time == 1 else away).rename(away if time == 1 else root)
        write(path, content)

    monkeypatch.setattr(run_folder, "write_json", write_json)
    start(scene, root, config=load_config(flags={**SETTINGS, "disk.retry": 0.01}))
    assert RunFolder(root).point_cloud.exists()
    assert not away.exists()


def test_a_resume_waits_for_a_disk_that_is_full_when_run_db_is_opened(
    killed: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    full = chain([True, True], repeat(False))

    def connect(*arguments: Any, **named: Any) -> sqlite3.Connection:
        if next(full):
            raise sqlite3.OperationalError("database or disk is full")
        return sqlite3.Connection(*arguments, **named)

    monkeypatch.setattr("panolog.orchestrator.runs.database.sqlite3.connect", connect)
    slept: list[float] = []
    monkeypatch.setattr("panolog.orchestrator.cli.session.session.time.sleep", slept.append)
    resume(killed)
    assert slept == [CONFIG.disk.retry] * 2
    (said,) = [text for text in caplog.messages if text.startswith("disk full")]
    assert "or stop the run" in said


def test_a_resumed_run_that_is_refused_says_why(killed: Path) -> None:
    with pytest.raises(InputError):
        resume(killed, fails(InputError("a.jpg is truncated")))
    found = status(killed)
    assert (found["status"], found["stage"], found["reason"]) == ("failed", "calibrate", "a.jpg is truncated")
    resume(killed)
    assert status(killed)["status"] == "done"


def test_an_odd_scene_and_a_gpu_that_torch_cannot_use_are_noticed(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scene is far from its origin, and its sky masks are inverted."""
    odd = copytree(scene, tmp_path / "scene")
    (odd / "skymasks").mkdir()
    for image in (odd / "images").iterdir():
        cv2.imwrite(str(odd / "skymasks" / f"{image.stem}.png"), np.zeros((32, 64), np.uint8))
    moved = replace(read_scene(odd), offset=(465_000.0, 5_250_000.0, 408.0))
    monkeypatch.setattr(preparing, "read_scene", lambda _: moved)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("panolog.renderer.process.unused_gpu", lambda: "RTX 4090 is not used: its driver")
    start(scene, tmp_path / "run")
    messages = notices(tmp_path / "run")
    assert any(str(moved.offset) in message for message in messages)
    assert any("black is sky; invert them" in message for message in messages)
    assert "RTX 4090 is not used: its driver; the CPU is used" in messages


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("bad"), "internal error: ValueError: bad; its traceback is in the last line of"),
        (ClusterLostError("Ray: no head"), "Ray: no head"),
    ],
)
def test_an_unforeseen_error_is_one_line_and_recorded(
    killed: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, line: str
) -> None:
    def workers(*given: Any) -> AbstractContextManager[FakePool]:
        given[-1]()  # what is done while it starts
        return nullcontext(calibrating(fails(error)))

    monkeypatch.setattr(session, "_workers", workers)
    metrics = "panolog.orchestrator.engine.cluster.run_metrics.RunMetrics"
    monkeypatch.setattr(metrics, lambda _, on_change: SimpleNamespace(show=on_change))
    answer = call("resume", killed, "--resumed-after", "killed by signal 9")
    assert (answer.exit_code, answer.stdout) == (1, "")
    assert "Traceback" not in answer.stderr
    assert answer.stderr.splitlines()[-1].startswith(f"panolog: {line}")
    notice, *_, ended = [item.record for item in read_records(RunFolder(killed).database)][-8:]
    assert notice == Noticed(None, "resumed by the supervisor after: killed by signal 9")
    assert isinstance(ended, RunEnded)
    assert (ended.outcome, ended.transient) == ("failed", True)
    assert ("Traceback" in ended.detail) == isinstance(error, ValueError)
    assert status(killed)["reason"] == ended.reason


def test_a_changed_scene_is_refused_with_the_file_that_was_written(scene: Path, tmp_path: Path) -> None:
    place, root = copytree(scene, tmp_path / "town"), tmp_path / "run"
    with pytest.raises(RunError):
        session.start(place, root, CONFIG, None, ignore, FakePool(fails_in_training, [MACHINE]))
    image = sorted((place / "images").iterdir())[1]
    image.write_bytes(image.read_bytes() + bytes(9))
    later = image.stat().st_mtime + 2  # run.json has whole seconds
    os.utime(image, (later, later))
    message = rf"since the run began \(images/{image.name} was written since\); put back"
    with pytest.raises(SceneError, match=message):
        resume(root)


def fails_in_training(spec: TaskSpec) -> Iterator[Event | Calibration]:
    if not isinstance(spec, CalibrateSpec):
        raise CrashError(DIED)
    yield from says(spec)


@pytest.fixture
def failed(scene: Path, tmp_path: Path) -> Path:
    """A run that has failed in Stage I."""
    root = tmp_path / "failed run"
    with pytest.raises(RunError):
        session.start(scene, root, CONFIG, None, ignore, FakePool(fails_in_training, [MACHINE]))
    return root


def edit(root: Path, **settings: Any) -> None:
    """What a text editor does with run.json; also removes settings, which are None then."""
    content = json.loads(RunFolder(root).info.read_bytes())
    content["config"] = {
        key: value for key, value in (content["config"] | settings).items() if value is not None
    }
    RunFolder(root).info.write_text(json.dumps(content))


def notices(root: Path) -> list[str]:
    return [notice["message"] for notice in status(root)["notices"]]


def test_edited_settings_are_refused_with_all_of_them_until_they_are_accepted(failed: Path) -> None:
    edit(failed, iterations=4, preview={"every": 7})
    result = call("resume", failed)
    assert (result.exit_code, result.stdout) == (2, "")
    changes = "preview.every = 7, not 500; iterations = 4, not 2"
    assert f"run.json: {changes}: not as the run was begun" in " ".join(result.stderr.split())
    assert status(failed)["status"] == "failed"  # as before: nothing has taken it over
    session.resume(failed, None, ignore, calibrating(), accept_changes=True)
    assert status(failed)["status"] == "done"
    assert f"resumed with other settings: {changes}" in notices(failed)


def test_what_was_accepted_is_what_the_next_driver_compares_with(failed: Path) -> None:
    edit(failed, iterations=4)
    failing = FakePool(fails_in_training, [MACHINE])
    with pytest.raises(RunError):
        session.resume(failed, None, ignore, failing, accept_changes=True)
    edit(failed, iterations=2)
    with pytest.raises(InputError, match=r"run\.json: iterations = 2, not 4: not as the run was begun"):
        resume(failed)
    edit(failed, iterations=4)
    resume(failed)


def test_a_setting_that_is_gone_from_run_json_is_a_change_if_that_changes_it(failed: Path) -> None:
    """What it leaves to the default."""
    edit(failed, iterations=None)
    with pytest.raises(InputError, match=r"iterations = 30000, not 2: not as"):
        resume(failed)
    edit(failed, iterations=2, seed=None)  # which is the default
    resume(failed)


def test_a_run_of_a_version_that_recorded_no_settings_resumes(
    failed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(sqlite3.connect(RunFolder(failed).database)) as connection, connection:
        for kind in ("RunBegan", "PreflightSaved"):
            connection.execute(
                "UPDATE events SET payload = json_remove(payload, '$.settings', '$.code') WHERE type = ?",
                (kind,),
            )
    edit(failed, iterations=4)
    resume(failed)


def test_other_sources_are_a_notice(failed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = own_code()
    monkeypatch.setattr("panolog.orchestrator.runs.info.own_code", lambda: "0123456789ab")
    resume(failed)
    line = f"resumed with other sources ({own} → 0123456789ab): what is trained now may differ"
    assert notices(failed).count(line) == 1


@pytest.mark.parametrize(
    ("given", "why"),
    [({"device": "cuda"}, "there is no GPU that torch can use"), ({"memory": 0.1}, "give at least")],
)
def test_what_cannot_be_is_refused_before_a_worker_starts(
    given: dict[str, object], why: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    pool = FakePool(fails_in_training, [MACHINE])
    with pytest.raises(InputError, match=why):
        session.start(scene, tmp_path / "run", load_config(flags=SETTINGS | given), None, ignore, pool)
    assert not (tmp_path / "run").exists() and pool.started == []
