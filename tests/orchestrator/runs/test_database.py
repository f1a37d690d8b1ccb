import shutil
import sqlite3
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.runs import sql, thinning
from panolog.orchestrator.runs.database import Database, read_milestones, read_news, read_records
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    ModelSaved,
    Noticed,
    Progressed,
    Record,
    RunBegan,
)
from panolog.orchestrator.runs.thinning import PREVIEWS, surplus
from panolog.orchestrator.watch.views import queries
from panolog.scene.errors import InputError, RunLockedError
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.fakes import SetClock

RATES = dict.fromkeys(("means", "quats", "scales", "opacities", "sh0", "shN"), 1e-3)
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


def test_milestones_leave_out_old_progress_without_a_look_at_it(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an older run, where every message is a row, the indexes lead to those that count."""
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(
            """
            WITH RECURSIVE n(i) AS (SELECT 8 UNION ALL SELECT i + 1 FROM n WHERE i < 20000)
            INSERT INTO events SELECT i, i, printf('block/%03d', i % 10), 'Progressed',
                    printf('{"task":"block/%03d","iteration":1,"iterations":2,"rate":1.0}', i % 10) FROM n;
            """
        )
    steps, connect = [0], sqlite3.connect

    def counted(*arguments: Any, **options: Any) -> sqlite3.Connection:
        connection: sqlite3.Connection = connect(*arguments, **options)
        connection.set_progress_handler(lambda: steps.append(1), 100)
        return connection

    monkeypatch.setattr(sqlite3, "connect", counted)
    assert [s.id for s in read_milestones(path)] == [1, 3, 5, 6, *range(19_991, 20_001)]
    assert len(steps) * 100 < 20_000  # instructions of SQLite


def test_a_copy_of_the_one_file_on_read_only_media_is_whole(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    folder.mkdir()
    shutil.copy(path, folder)
    (folder / "run.db").chmod(0o444)
    folder.chmod(0o555)
    assert len(read_records(folder / "run.db")) == len(HISTORY)
    folder.chmod(0o755)


def test_of_days_of_progress_some_is_stored_and_the_latest_is_known(tmp_path: Path) -> None:
    path, clock, sent = tmp_path / "run.db", SetClock(), 0
    for driver in range(3):  # each has begun at the last checkpoint again
        with closing(Database(path, clock)) as database:
            database.append([RunBegan("host", driver, resumed=driver > 0)])
            size = path.stat().st_size
            for first in range(1, 4_321, 60):
                records: list[tuple[float, Record]] = []
                for iteration in range(first, first + 60):
                    clock.now += 20.0
                    progress = Progressed(COARSE, iteration, 4_320, 2.0, 0.5, 20.0, 10, 2**30, None, RATES)
                    records.append((clock.now, progress))
                sent += len(database.store(records))
        milestones = read_milestones(path)
        assert (milestones[-1].record, milestones[-1].time) == (progress, clock.now)
    stored = [item for item in read_records(path, limit=100_000) if isinstance(item.record, Progressed)]
    assert sent == 12_960
    assert 400 < len(stored) <= thinning.most_stored(3 * 86_400)
    assert path.stat().st_size < size + len(stored) * thinning.ROW
    assert [item.id for item in stored] == sorted({item.id for item in stored})


def test_the_end_of_a_task_stores_its_last_progress(tmp_path: Path) -> None:
    path, clock = tmp_path / "run.db", SetClock()
    with closing(Database(path, clock)) as database:
        database.append([Progressed(COARSE, i, 200, 2.0) for i in range(1, 151)])
        clock.now += 0.1
        database.append([Progressed(COARSE, 200, 200, 2.0)])
        time, done = clock.now, ModelSaved(COARSE, "coarse/model.ply", 1, 1, 200, 1.0)
        clock.now += 0.1
        database.append([done])
    *_, last, end = read_records(path)
    assert (last.record, last.time, end.record) == (Progressed(COARSE, 200, 200, 2.0), time, done)
    assert len(read_records(path)) == 100 + 2


def test_news_has_progress_that_is_not_stored(tmp_path: Path) -> None:
    path, clock = tmp_path / "run.db", SetClock()
    with closing(Database(path, clock)) as database:
        *_, last = database.append([Progressed(COARSE, i, 200, 2.0) for i in range(1, 151)])
        (block,) = database.append([Progressed(TaskId.block(0), 1, 200, 2.0)])
        assert read_news(path, 99, 10) == [read_records(path, 99)[0], last, block]
        assert read_news(path, last.id, 10) == [block]
        assert database.append([Noticed(COARSE, "more")])[0].id == block.id + 1
    with closing(Database(path, clock)) as database:
        assert database.append([Noticed(COARSE, "more")])[0].id == block.id + 2


def test_a_database_of_an_older_version_is_read_and_continued(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript("DROP TABLE latest; DROP INDEX drivers; DROP TABLE nodes")
    assert [s.id for s in read_milestones(path)] == [1, 3, 5, 6, 7]
    assert [s.id for s in read_news(path, 4, 10)] == [5, 6, 7]
    assert sql.version(path)[1:] == (7, None, None)
    assert queries.usages(path) == {}
    with closing(Database(path)) as database:
        assert [s.id for s in database.milestones()] == [1, 3, 5, 6, 7]
        assert database.append([Progressed(COARSE, 3, 10, 2.0)])[0].id == 8
    assert [s.id for s in read_milestones(path)] == [1, 3, 6, 7, 8]


def test_of_two_drivers_the_earlier_ends_and_writes_nothing_more(tmp_path: Path) -> None:
    """Where locks do not work."""
    path = tmp_path / "run.db"
    with closing(Database(path)) as first, closing(Database(path)) as second:
        first.append([RunBegan("a", 1, resumed=False)])
        first.append([Noticed(COARSE, "of the first")])
        second.append([RunBegan("b", 2, resumed=True)])
        for write in (lambda: first.append([Noticed(COARSE, "more")]), lambda: first.put_usage("node", {})):
            with pytest.raises(RunLockedError, match="another driver has taken the run over"):
                write()
        second.append([Noticed(COARSE, "of the second")])
    messages = [item.record.message for item in read_records(path) if isinstance(item.record, Noticed)]
    assert messages == ["of the first", "of the second"]
    assert [item.id for item in read_records(path)] == [1, 2, 3, 4]
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT COUNT(*) FROM nodes").fetchone() == (0,)


def test_a_missing_or_foreign_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        read_records(tmp_path / "run.db")
    (tmp_path / "run.db").write_text("hello, this is no database at all")
    with pytest.raises(InputError, match=r"cannot be used as the database of a run .*put back a copy"):
        read_records(tmp_path / "run.db")
    with pytest.raises(InputError, match="cannot be used as the database"):
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


# Previews


def test_previews_are_the_first_the_latest_and_some_evenly_between() -> None:
    kept: list[int] = []
    for iteration in range(500, 100_001, 500):
        kept.append(iteration)
        if (gone := surplus(kept, iteration)) is not None:
            kept.remove(gone)
        assert len(kept) <= PREVIEWS
        assert (kept[0], kept[-1]) == (500, iteration)
    gaps = [after - before for before, after in pairwise(kept)]
    assert max(gaps) < 2 * 100_000 / PREVIEWS


def test_the_preview_of_a_repeated_iteration_is_kept() -> None:
    kept = list(range(100, 100 * PREVIEWS + 1, 100))
    assert surplus(sorted([*kept, 501]), 501) in (500, 600)
