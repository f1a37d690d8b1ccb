"""The messages of an open page, whatever happens to the run or the server."""

import os
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import ModelSaved, Noticed, RunBegan
from panolog.orchestrator.runs.thinning import DENSE
from panolog.orchestrator.watch.dashboard import watch as dashboard_watch
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.dashboard.watch import Watch
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.served import (
    progressed,
    serving,
    started,
    streaming,
    write_run,
    write_whole_run,
)

pytestmark = pytest.mark.system


def until(messages: Iterator[tuple[str, Any]], event: str) -> Any:
    """The content of the next message of that kind."""
    return next(content for kind, content in messages if kind == event)


def test_small_changes_are_small(tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    with serving(tmp_path) as served, streaming(served, f"?run={served.id('run')}&changes=1") as messages:
        whole = until(messages, "run")
        append(folder, progressed(TaskId.block(0), 76), progressed(TaskId.block(0), 77))
        changes, news = until(messages, "changes"), until(messages, "events")
        assert [event["iteration"] for event in news["events"]] == [77]  # of progress only the latest
        assert [task["name"] for task in changes["tasks"]] == ["block/000"]
        assert changes["tasks"][0]["iteration"] == 77
        assert "tasks" not in changes["summary"]
        assert changes.keys() - {"tasks"} < whole.keys()
        append(folder, ModelSaved(TaskId.block(0), "x", 1, 1, 100, 1.0))  # the merge is worthless now
        assert until(messages, "run")["summary"]["model"] is None


def test_the_times_of_a_live_run_go_on_while_it_records_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dashboard_watch, "_AGE_S", 1e-9)
    folder = write_run(tmp_path / "run", [RunBegan("host", 1, resumed=False), started(COARSE)])
    watch = Watch(RunEntry(tmp_path, "run"))

    def elapsed() -> tuple[float, float]:
        watch.refresh_row()
        page = watch.snapshot.page
        assert page is not None and page.summary.seconds is not None
        return page.summary.seconds, watch.snapshot.row.seconds or 0.0

    with lock.hold(folder.lock):
        before, later = elapsed(), elapsed()
    assert later[0] > before[0] and later[1] > before[1]
    watch.refresh()
    assert watch.refresh() == watch.refresh()  # of a run at rest nothing is sent again


def test_a_run_can_vanish_and_come_back_with_and_without_clients(tmp_path: Path) -> None:
    write_whole_run(tmp_path / "run")
    with serving(tmp_path) as served:
        id = served.id("run")
        with streaming(served, f"?run={id}") as messages:
            until(messages, "run")
            (tmp_path / "run").rename(tmp_path / "moved")
            assert "run: " in until(messages, "gone")["error"]
            assert served.errors(f"/api/runs/{id}", 404)
            write_run(tmp_path / "run", [Noticed(None, "another")])
            while not (notices := until(messages, "run")["summary"]["notices"]):
                pass  # it was read before its first record
            assert notices[0]["message"] == "another"
        (tmp_path / "run").rename(tmp_path / "again")
        while any(row["name"] == "run" for row in served.get("/api/runs")["runs"]):
            pass
        write_run(tmp_path / "run")
        while served.client.get(f"/api/runs/{id}").status_code == 404:
            pass


def test_a_damaged_run_says_so_and_harms_no_other(tmp_path: Path) -> None:
    write_whole_run(tmp_path / "good")
    content = (tmp_path / "good" / "run.db").read_bytes()
    harm: dict[str, tuple[str, bytes]] = {
        "empty": ("run.db", b""),
        "text": ("run.db", b"no database" * 100),
        "cut": ("run.db", content[:5000]),
        "foreign": ("run.db", content.replace(b"TaskStarted", b"TaskStopped")),
        "strange": ("run.db", content.replace(b'"iterations":100', b'"iterations":"x"')),
        "no info": ("run.json", b"[]"),
        "bad info": ("run.json", b'{"config": [], "scene": 7, "created": NaN}'),
    }
    for name, (file, damage) in harm.items():
        (write_whole_run(tmp_path / name).root / file).write_bytes(damage)
    with serving(tmp_path) as served:
        for row in served.get("/api/runs")["runs"]:
            if row["name"] == "good":
                assert row["error"] is None
            elif row["name"] not in ("empty", "bad info"):
                assert row["status"] == "unreadable", row
                assert "\n" not in row["error"]
                assert str(tmp_path) not in row["error"]
            for path in ("", "/events", "/series?task=coarse", "/previews", "/views", "/map"):
                status = served.client.get(f"/api/runs/{row['id']}{path}").status_code
                assert status in ((200,) if row["name"] == "good" else (200, 404, 503)), (row, path)


def test_a_read_only_copy_shows_all_and_allows_nothing(tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    names = set(folder.root.iterdir())
    for path in folder.root.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    folder.root.chmod(0o555)
    try:
        with serving(tmp_path) as served:
            page = served.get(f"/api/runs/{served.id('run')}")
            assert page["summary"]["status"] == "stopped"
            if os.geteuid():
                assert "you may not write to run" in page["actions"]["why"]
            assert set(folder.root.iterdir()) == names
    finally:
        folder.root.chmod(0o755)
        for path in folder.root.rglob("*"):
            path.chmod(0o755)


def test_resuming_that_fails_says_why(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    host = socket.gethostname()
    write_run(tmp_path / "run", [RunBegan(host, 1, resumed=False), started(COARSE)], scene=str(scene))
    with serving(tmp_path) as served, streaming(served, f"?run={served.id('run')}") as messages:
        until(messages, "run")
        assert served.act(served.id("run"), "resume").status_code == 202
        assert served.act(served.id("run"), "resume").status_code == 409
        page = until(messages, "run")
        while page["actions"]["failed"] is None:
            assert page["actions"]["available"] == []
            page = until(messages, "run")
    assert page["actions"]["failed"].startswith(f"panolog: {scene}: ")
    assert page["actions"]["available"] == ["resume"]


# Another process that commits, for which it must have the file for itself.
_COMMIT = """
import sqlite3, sys
writer = sqlite3.connect(sys.argv[1], timeout=0)
try:
    with writer:
        writer.execute("INSERT INTO nodes VALUES ('other', 0, '{}')")
except sqlite3.OperationalError as error:
    sys.exit("locked" in str(error))
"""


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return write_whole_run(tmp_path / "run")


@contextmanager
def read_lock(database: Path) -> Iterator[None]:
    """What another thread of the dashboard has while it reads."""
    with closing(sqlite3.connect(database, isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT COUNT(*) FROM events").fetchone()
        yield


def locked(database: Path) -> bool:
    """Whether another process is kept from a commit."""
    return bool(subprocess.run([sys.executable, "-c", _COMMIT, str(database)], check=False).returncode)


def test_a_refresh_keeps_the_locks_of_other_threads(folder: RunFolder) -> None:
    watch = Watch(RunEntry(folder.root.parent, "run"))
    with read_lock(folder.database):
        watch.refresh()
        watch.refresh_row()
        assert watch.snapshot.row.status != "unreadable"
        assert locked(folder.database)
        folder.database.open("rb").close()  # what a refresh must not do
        assert not locked(folder.database)


def test_a_refresh_finds_progress_that_is_not_stored(folder: RunFolder) -> None:
    watch = Watch(RunEntry(folder.root.parent, "run"))
    append(folder, *(progressed(COARSE, 1 + number) for number in range(DENSE)))
    version = watch.refresh()
    assert watch.refresh() == version
    append(folder, progressed(COARSE, 99))
    assert watch.refresh() > version
    version = watch.refresh()
    state = watch.history.state.task(COARSE)
    assert state.progress is not None
    assert state.progress.iteration == 99
    append(folder, Noticed(COARSE, "more"))
    assert watch.refresh() > version


def test_a_database_that_is_replaced_is_read_anew(folder: RunFolder, tmp_path: Path) -> None:
    watch = Watch(RunEntry(folder.root.parent, "run"))
    watch.refresh()
    other = write_whole_run(tmp_path / "other")
    append(other, Noticed(COARSE, "of the other"))
    other.database.replace(folder.database)
    watch.refresh()
    assert list(watch.history.state.notices)[-1].message == "of the other"
