import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.run.records import CheckpointSaved, Noticed, Progressed, Record, RunBegan
from panolog.orchestrator.run.store import Database, read_milestones, read_records
from panolog.scene.errors import InputError
from panolog.workers.tasks import COARSE, EVAL, TaskId

HISTORY: list[Record] = [
    RunBegan("host", 1, resumed=False),
    Progressed(COARSE, 1, 10, 2.0, loss=0.5),
    Noticed(COARSE, "left out"),
    Progressed(TaskId.block(0), 1, 10, 2.0),
    Progressed(COARSE, 2, 10, 2.0, loss=0.4, rates={"means": 1e-3}),
    CheckpointSaved(COARSE, 2, "p", 1),
    Progressed(TaskId.block(0), 3, 10, 2.0),
]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    database = Database(tmp_path / "run.db")
    database.append(HISTORY[:4])
    database.append(HISTORY[4:])
    database.close()
    return tmp_path / "run.db"


def test_records_come_back_in_order(path: Path) -> None:
    stored = read_records(path)
    assert [s.record for s in stored] == HISTORY
    assert [s.id for s in stored] == list(range(1, 8))
    assert [s.id for s in read_records(path, after=3, limit=2)] == [4, 5]


def test_milestones_leave_out_old_progress(path: Path) -> None:
    assert [s.id for s in read_milestones(path)] == [1, 3, 5, 6, 7]


def test_another_writer_counts_on(path: Path) -> None:
    database = Database(path)
    assert [s.id for s in database.milestones()] == [1, 3, 5, 6, 7]
    assert database.append([Noticed(EVAL, "more")])[0].id == 8
    database.close()


def test_metrics_are_series(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        rows = connection.execute(
            "SELECT name, iteration, value FROM metrics WHERE task = 'coarse'"
        ).fetchall()
    assert {("loss", 1, 0.5), ("loss", 2, 0.4), ("rate/means", 2, 1e-3)} <= set(rows)


def test_readers_see_each_commit_of_a_live_run_and_do_not_stop_it(tmp_path: Path) -> None:
    database = Database(tmp_path / "run.db")
    for count in (1, 2, 3):
        database.append([Noticed(COARSE, str(count))])
        assert len(read_records(tmp_path / "run.db")) == count
    database.close()


def test_a_copy_of_the_one_file_on_read_only_media_is_whole(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    folder.mkdir()
    shutil.copy(path, folder)
    (folder / "run.db").chmod(0o444)
    folder.chmod(0o555)
    assert len(read_records(folder / "run.db")) == len(HISTORY)
    folder.chmod(0o755)


def test_a_transaction_cut_off_by_a_kill_is_rolled_back_for_readers(path: Path, tmp_path: Path) -> None:
    """What a kill in the middle of a commit leaves: changed pages in the file and a journal next to it."""
    dead = tmp_path / "dead"
    dead.mkdir()
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA cache_size = 1")  # pages spill into the file before the commit
    writer.executemany(
        "INSERT INTO events VALUES (NULL, 0, 'x', 'Noticed', ?)", [('{"task":"x","message":"y"}',)] * 2000
    )
    journal = path.with_name("run.db-journal")
    assert journal.exists()
    for file in (path, journal):
        shutil.copy(file, dead)
    writer.close()
    assert [s.record for s in read_records(dead / "run.db")] == HISTORY
    assert (dead / "run.db-journal").exists()  # looking changed nothing


def test_a_missing_or_foreign_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        read_records(tmp_path / "run.db")
    (tmp_path / "run.db").write_text("hello, this is no database at all")
    with pytest.raises(InputError, match="cannot be read"):
        read_records(tmp_path / "run.db")
    with pytest.raises(InputError, match="cannot be opened"):
        Database(tmp_path / "run.db")


@pytest.mark.parametrize("half_made", ["", "CREATE TABLE events (id, time, task, type, payload);"])
def test_a_database_whose_making_was_cut_off_has_no_rows_and_is_made_whole(
    tmp_path: Path, half_made: str
) -> None:
    path = tmp_path / "run.db"
    path.touch()
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(half_made)
    assert read_records(path) == read_milestones(path) == []
    with closing(Database(path)) as database:
        database.append(HISTORY)
    assert len(read_records(path)) == len(HISTORY)


@pytest.mark.system
def test_the_state_of_a_million_rows_is_read_at_once(tmp_path: Path) -> None:
    path = tmp_path / "run.db"
    Database(path).close()
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA synchronous = OFF")
    connection.executescript(
        """
        WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 1000000)
        INSERT INTO events SELECT i, i, printf('block/%03d', i % 100), 'Progressed',
                printf('{"task":"block/%03d","iteration":1,"iterations":2,"rate":1.0}', i % 100) FROM n;
        """
    )
    connection.close()
    before = time.process_time()
    assert len(read_milestones(path)) == 100
    assert time.process_time() - before < 0.2
    assert path.stat().st_size > 50e6
