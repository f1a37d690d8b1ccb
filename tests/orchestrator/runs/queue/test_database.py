"""The database of a queue: order, what each state allows, several commands at once, no queue at all."""

import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.database import DATABASE, Queue, default_folder, opened
from panolog.orchestrator.runs.queue.entries import Command, Needs, Share, State
from panolog.orchestrator.runs.queue.view import view_queue
from panolog.scene.errors import QueueError
from tests.orchestrator.fakes import SetClock

VERSION_1 = """
CREATE TABLE entries (
    id INTEGER PRIMARY KEY AUTOINCREMENT, position INTEGER NOT NULL, state TEXT NOT NULL,
    run TEXT NOT NULL, first TEXT NOT NULL, later TEXT NOT NULL, folder TEXT NOT NULL,
    added REAL NOT NULL, began REAL, ended REAL, boot TEXT, pid INTEGER, started INTEGER,
    starts INTEGER NOT NULL DEFAULT 0, losses INTEGER NOT NULL DEFAULT 0, code INTEGER,
    reason TEXT NOT NULL DEFAULT '');
PRAGMA user_version = 1;
"""


def command(name: str) -> Command:
    return Command(
        Path("/runs", name), ("/scene", "--output", f"/runs/{name}", "--set", "a=1"), (), Path("/")
    )


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[Queue]:
    with closing(Queue(tmp_path / "queue")) as found:
        for name in "abcd":
            found.add(command(name))
        yield found


def names(queue: Queue) -> str:
    return "".join(entry.command.run.name for entry in queue.entries())


@pytest.mark.parametrize(
    ("id", "before", "order"),
    [(4, 1, "dabc"), (1, None, "bcda"), (2, 4, "acbd"), (3, 3, "abcd"), (1, 2, "abcd")],
)
def test_moves(queue: Queue, id: int, before: int | None, order: str) -> None:
    queue.move(id, before)
    assert names(queue) == order
    assert [entry.position for entry in queue.entries()] == [1, 2, 3, 4]


def test_what_is_added_comes_back(queue: Queue) -> None:
    assert queue.entry(2).command == command("b")
    with pytest.raises(QueueError, match=r"/runs/b: is in the queue already, as number 2 \(waiting\)"):
        queue.add(command("b"))
    queue.remove(2)
    assert queue.add(command("b")) == 5  # no number is used twice
    assert [entry.state for entry in queue.entries(removed=True)].count(State.REMOVED) == 1


def test_each_state_allows_what_makes_sense(queue: Queue) -> None:
    claimed = queue.claim(1)
    assert claimed is not None and claimed.state == State.RUNNING
    with pytest.raises(QueueError, match="entry 1 is running: only what is waiting can be moved"):
        queue.move(1, None)
    with pytest.raises(QueueError, match="only what is waiting can be a place to move to"):
        queue.move(2, 1)
    with pytest.raises(QueueError, match=r"stop it first: `panolog stop /runs/a`"):
        queue.remove(1)
    with pytest.raises(
        QueueError, match="entry 2 is waiting: only what is failed or stopped can be tried again"
    ):
        queue.retry(2)
    with pytest.raises(QueueError, match="entry 2 is waiting: only what is running can be ended"):
        queue.end(2, State.DONE, 0, "")
    queue.end(1, State.FAILED, 1, "why")
    assert (queue.entry(1).state, queue.entry(1).reason) == (State.FAILED, "why")
    queue.retry(1)
    assert names(queue) == "bcda"
    with pytest.raises(QueueError, match="the queue has no entry 9; `panolog queue list` shows all"):
        queue.remove(9)
    queue.remove(3)
    with pytest.raises(QueueError, match="the queue has no entry 3"):
        queue.move(3, None)


def test_an_entry_is_claimed_once(queue: Queue, tmp_path: Path) -> None:
    with closing(Queue(tmp_path / "queue")) as other:
        claimed = [one.claim(id) for one, id in ((queue, 1), (other, 1), (other, 3), (queue, 3), (queue, 9))]
        assert [entry and entry.id for entry in claimed] == [1, None, 3, None, None]
        assert [one.next() for one in (queue, other)] == [queue.entry(2)] * 2


def test_a_start_is_on_disk_with_its_process(queue: Queue, tmp_path: Path) -> None:
    queue.claim(1)
    me = processes.identity(1)
    queue.launched(1, me)
    with opened(tmp_path / "queue", make=False) as other:
        (entry,) = other.running()
    assert (entry.process, entry.starts) == (me, 1)
    assert queue.lose(1) == 1


def test_kills_count_in_a_row_only_if_they_come_soon(tmp_path: Path) -> None:
    clock = SetClock()
    with closing(Queue(tmp_path / "queue", clock)) as queue:
        queue.add(command("a"))
        queue.claim(1)
        counts = []
        for seconds in (5.0, 5.0, 700.0, 5.0):
            queue.launched(1, processes.identity(1))
            clock.now += seconds
            counts.append(queue.lose(1))
    assert counts == [1, 2, 1, 2]


def test_needs_and_shares_come_back(queue: Queue) -> None:
    for needs in (Needs(gpus=2, memory=2**34), Needs(0, 3, None), None):
        run = command("e")
        number = queue.add(Command(run.run, run.first, run.later, run.folder, needs))
        assert queue.entry(number).command.needs == needs
        queue.remove(number)
    assert queue.entry(2).command.needs == Needs()
    queue.claim(1)
    share = Share(("GPU-a",), (0, 2), 2**33)
    queue.note(1, "waits for memory")
    assert queue.entry(1).reason == "waits for memory"
    assert view_queue(queue).reason(queue.entry(1)) == ""  # no runner is at work
    queue.launched(1, processes.identity(1), share)
    assert (queue.entry(1).share, queue.entry(1).reason) == (share, "")
    queue.end(1, State.DONE, 0, "")
    queue.note(1, "too late")
    assert (queue.entry(1).share, queue.entry(1).reason) == (None, "")


def test_a_queue_of_version_1_is_taken_over(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / DATABASE)) as database:
        database.executescript(VERSION_1)
        for number, words in enumerate(['["/s", "--output", "/r"]', '["/s", "--address", "auto"]'], 1):
            row = (number, "waiting", f"/r{number}", words, "[]", "/", 1.0)
            database.execute(
                "INSERT INTO entries (position, state, run, first, later, folder, added)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                row,
            )
        database.commit()
    with closing(Queue(tmp_path)) as queue:
        assert [entry.command.needs for entry in queue.entries()] == [Needs(), None]
        assert queue.add(command("new")) == 3
    with closing(Queue(tmp_path)) as queue:  # which is not changed again
        assert len(queue.entries()) == 3


def test_many_commands_at_once_lose_nothing(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from panolog.orchestrator.runs.queue.database import opened;"
        "from panolog.orchestrator.runs.queue.entries import Command\n"
        "for number in range(8):\n"
        "    with opened(Path(sys.argv[1])) as queue:\n"
        "        queue.add(Command(Path(f'/{sys.argv[2]}-{number}'), (), (), Path('/')))\n"
        "        queue.move(queue.entries()[-1].id, queue.entries()[0].id)\n"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "queue"), str(number)])
        for number in range(3)
    ]
    assert [process.wait(300) for process in processes] == [0] * 3
    with closing(Queue(tmp_path / "queue")) as queue:
        entries = queue.entries()
    assert len({entry.command.run for entry in entries}) == 24
    assert sorted(entry.position for entry in entries) == list(range(1, 25))


def test_what_is_no_queue_is_one_clear_line(tmp_path: Path) -> None:
    with (
        pytest.raises(QueueError, match="has no queue yet; `panolog queue add` makes one"),
        opened(tmp_path, make=False),
    ):
        raise AssertionError
    (tmp_path / DATABASE).write_bytes(b"no database, but longer than the header of one: " * 9)
    with pytest.raises(QueueError, match="cannot be used as a queue: file is not a database; move it away"):
        Queue(tmp_path)
    other = tmp_path / "newer"
    with closing(Queue(other)), closing(sqlite3.connect(other / DATABASE)) as database:
        database.execute("PRAGMA user_version = 3")
    with pytest.raises(QueueError, match=r"is of a newer PanoLOG \(version 3, this one knows 2\)"):
        Queue(other)
    (tmp_path / "file").touch()
    with pytest.raises(QueueError, match="cannot be created: "):
        Queue(tmp_path / "file" / "queue")


def test_the_queue_of_a_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert default_folder() == Path("/state/panolog/queue")
    monkeypatch.setenv("PANOLOG_QUEUE", "/my/queue")
    assert default_folder() == Path("/my/queue")
