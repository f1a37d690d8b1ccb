"""Databases whose driver was killed in the middle of a commit."""

import os
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.runs import lock, sql
from panolog.orchestrator.runs.database import Database, read_records
from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.records import Noticed
from panolog.scene.errors import InputError
from panolog.workers.tasks import COARSE
from tests.orchestrator.fakes import SetClock

# A writer that is killed between the first changed page and its commit.
_KILLED = """
import os, signal, sqlite3, sys
writer = sqlite3.connect(sys.argv[1])
writer.execute("PRAGMA cache_size = 1")
writer.executemany("UPDATE events SET payload = ? WHERE id = ?", [("x" * 4000, i) for i in range(1, 101)])
writer.executemany("INSERT INTO events VALUES (NULL, 0, 'x', 'Noticed', ?)", [("y" * 4000,)] * 100)
os.kill(os.getpid(), signal.SIGKILL)
"""
MESSAGES = [f"notice {number}" for number in range(100)]


@pytest.fixture
def dead(tmp_path: Path) -> Path:
    """The database of a driver that was killed in the middle of a commit."""
    path = tmp_path / "run.db"
    with closing(Database(path)) as database:
        database.append([Noticed(COARSE, message) for message in MESSAGES])
    ended = subprocess.run([sys.executable, "-c", _KILLED, str(path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert journal(path).stat().st_size > 0
    uri = f"{path.as_uri()}?mode=ro"
    with (
        closing(sqlite3.connect(uri, uri=True)) as reader,
        pytest.raises(sqlite3.OperationalError, match="readonly"),
    ):
        reader.execute("SELECT * FROM events").fetchall()
    return path


def journal(path: Path) -> Path:
    return path.with_name("run.db-journal")


def messages(path: Path) -> list[str]:
    return [item.record.message for item in read_records(path) if isinstance(item.record, Noticed)]


def refused(*_: object) -> None:
    raise AssertionError("the database was copied")


def test_a_reader_rolls_it_back_in_place(dead: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql, "copyfile", refused)
    assert messages(dead) == MESSAGES
    assert not journal(dead).exists()
    assert sql.version(dead)[1] == len(MESSAGES)


def test_a_reader_leaves_it_to_a_driver_that_starts(dead: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql, "copyfile", refused)

    class Starting(SetClock):
        def sleep(self, seconds: float) -> None:
            super().sleep(seconds)
            Database(dead).close()

    monkeypatch.setattr(sql, "time", Starting())
    with lock.hold(dead.with_name("lock")):
        assert messages(dead) == MESSAGES


def test_the_folder_of_another_user_stays_as_it_is(dead: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = dead.read_bytes(), journal(dead).read_bytes()
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    assert sql.version(dead) == sql.version(dead)  # and no copy is made for it
    assert messages(dead) == MESSAGES
    assert (dead.read_bytes(), journal(dead).read_bytes()) == before


def test_a_path_may_lead_over_the_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite refuses `/../tmp`, which a relative path becomes in the folder /."""
    monkeypatch.chdir("/")
    folder = Path("..", *tmp_path.parts[1:])
    with closing(Database(folder / "run.db")) as database:
        database.append([Noticed(COARSE, MESSAGES[0])])
    assert messages(folder / "run.db") == MESSAGES[:1]
    with closing(Queue(folder)) as queue:
        assert queue.entries() == []


@pytest.mark.parametrize("read", [read_records, Database, sql.version])
def test_a_journal_that_names_another_file_does_not_remove_it(
    dead: Path, read: Callable[[Path], object]
) -> None:
    """What SQLite does with the super-journal of a transaction over several databases."""
    victim = dead.with_name("victim")
    victim.write_bytes(b"precious")
    name = str(victim).encode()
    with journal(dead).open("ab") as file:  # https://sqlite.org/src/file/src/pager.c, writeSuperJournal
        page = 2**30 // 4096 + 1
        file.write(struct.pack(">I", page) + name)
        file.write(struct.pack(">II", len(name), sum(name) & 0xFFFFFFFF) + bytes.fromhex("d9d505f920a163d7"))
    copied = dead.parent / "copy"
    copied.mkdir()
    for file_ in (dead, journal(dead)):
        shutil.copy(file_, copied)
    with pytest.raises(InputError, match="not the journal of a run"):
        read(copied / "run.db")
    assert victim.exists()
    with closing(sqlite3.connect(dead)) as careless:
        careless.execute("SELECT COUNT(*) FROM events").fetchone()
    assert not victim.exists()  # what the refusal prevents
