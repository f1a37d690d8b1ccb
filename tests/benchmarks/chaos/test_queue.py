"""The benchmark of a queue: what it reports of runs that are not as they should be."""

import random
from contextlib import closing
from pathlib import Path

from benchmarks.chaos.queue import Queued
from panolog.orchestrator.queue.entries import Command, State
from panolog.orchestrator.queue.store import Queue
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.store import Database


def begun(folder: RunFolder, time: float, model: bytes) -> None:
    folder.root.mkdir()
    folder.point_cloud.write_bytes(model)
    with closing(Database(folder.database)) as database:
        database.store([(time, RunBegan("host", 1, False)), (time + 9, RunBegan("host", 2, True))])


def test_states_order_and_bytes_are_checked(tmp_path: Path) -> None:
    queued = Queued(tmp_path, 1, random.Random(0))
    with closing(Queue(tmp_path / "queue")) as queue:
        for number, (time, model) in enumerate([(1.0, b"a"), (3.0, b"a"), (2.0, b"b"), (4.0, b"a")], 1):
            root = tmp_path / f"run-{number:03d}"
            queue.add(Command(root, (), (), tmp_path))
            begun(RunFolder(root), time, model)
            queue.claim(number)
            queue.end(number, State.FAILED if number == 4 else State.DONE, 0, "why")
    assert queued.wrong() == [
        "entry 4 is failed: why",
        "they began in another order: [1, 3, 2]",
        "entry 3 has other bytes than the first",
    ]
    assert queued.drivers() == 8
    queued.at_once = 2  # two that begin together may do so in either order
    assert queued.wrong() == ["entry 4 is failed: why", "entry 3 has other bytes than the first"]
