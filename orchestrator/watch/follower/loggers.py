"""Passes curves on to one sink, in a thread of its own.

Only what is settled is passed on, and before that is done the ledger notes which piece it is: after a kill in
between, the next follower reads back what the sink has of that piece, and adds the rest. So no point is
missing or doubled, whatever was killed or resumed.
"""

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs.folder import RunFolder, flat, read_json
from panolog.orchestrator.runs.sql import query
from panolog.orchestrator.watch.follower.board import Board, News
from panolog.orchestrator.watch.follower.ledger import Ledger
from panolog.orchestrator.watch.follower.sinks.interface import Facts, Point, Sink, Value
from panolog.scene.errors import RunFolderError

_IDLE_S = 60.0  # between two looks without news
_LOCK_S = 5.0  # to wait for the driver's lock
# The settled part of a curve, as run.db has it in the end: each iteration once. After a failure a task
# continues from its latest checkpoint, and iterations that follow it come again. A row counts only if no row
# of an earlier iteration is newer; up to a checkpoint no newer rows will come.
_ROWS = """
WITH thin AS (
    SELECT name, iteration, MAX(rowid) AS row FROM metrics
    WHERE task = :task AND iteration <= :until GROUP BY name, iteration),
kept AS (SELECT row, iteration, MAX(row) OVER (PARTITION BY name ORDER BY iteration) AS newest FROM thin)
SELECT name, iteration, time, value FROM metrics
WHERE rowid IN (SELECT row FROM kept WHERE row = newest AND iteration > :after) ORDER BY iteration, name
"""


class Logger(threading.Thread):
    """One sink of a run."""

    def __init__(self, name: str, make: Callable[[], Sink], board: Board, root: Path, path: Path) -> None:
        """Args: name, of the sink; make, makes it; root, of the run; path, of the sink's ledger."""
        super().__init__(name=name, daemon=True)
        self.label = f"log {name}"
        self.problem = ""  # why something was not passed on; one line
        self._make, self._board, self._folder, self._path = make, board, RunFolder(root), path
        self._sink: Sink | None = None
        self._unsure: list[Any] = []  # task, after, until of a piece that the sink may have in part

    def run(self) -> None:
        """Works until the run has ended and all is passed on, or no time is left."""
        news, failures = self._board.news, 0
        errors: tuple[type[Exception], ...] = (*Sink.errors, RunFolderError)
        while not (news.ended and (not news.run or self._board.left <= 0)):
            try:
                if news.run:
                    if self._sink is None:
                        sink = self._make()
                        errors = (*sink.errors, RunFolderError)
                        self._begin(sink, news)
                    self._pass_on(news)
                    if news.ended:
                        self._finish(news)
                        return
                failures, self.problem = 0, ""
                news = self._board.wait(_IDLE_S, news)
            except errors as error:
                self.problem = f"not all was passed on: {type(error).__name__}"
                self._board.pause(failures)
                news, failures = self._board.news, failures + 1

    def _begin(self, sink: Sink, news: News) -> None:
        """Takes up the run there."""
        self._ledger = Ledger(self._path, news.run)
        facts = Facts(news.run, self._folder.root.resolve().name, settings_of(self._folder))
        known = self._ledger.get("there", "")
        there = sink.open(facts, known)
        if there != known:
            self._ledger.keep(there=there)
        self._unsure = self._ledger.get("piece", [])
        self._logged: dict[str, int] = dict(self._ledger.get("logged", {}))
        self._sink = sink

    def _pass_on(self, news: News) -> None:
        """Adds what is settled and not there yet."""
        if self._unsure:
            self._add(*self._unsure, check=True)
        for task, until in news.settled.items():
            after = self._logged.get(task, 0)
            if until > after:
                self._add(task, after, until, check=False)

    def _add(self, task: str, after: int, until: int, *, check: bool) -> None:
        """One piece. Args: check, reads back what the sink has of it."""
        assert self._sink is not None  # `_begin` comes first
        wanted = _points(self._folder.database, task, after, until)
        if wanted:
            self._unsure = [task, after, until]
            self._ledger.keep(piece=self._unsure)
            names = sorted({point.name for point in wanted})
            there = self._sink.present(task, after, until, names) if check else set()
            self._sink.log(task, [it for it in wanted if (it.name, it.iteration) not in there])
        self._logged[task] = until
        self._ledger.keep(logged=self._logged, piece=[])
        self._unsure = []

    def _finish(self, news: News) -> None:
        """What comes last, once for each end of the run."""
        assert self._sink is not None  # `_begin` comes first
        end = [news.began, str(news.outcome or "")]
        metrics: Mapping[str, float] = {}
        if self._ledger.get("end", []) != end:
            metrics = {name: value for name, value in news.metrics.items() if value is not None}
        report = self._folder.report
        self._sink.finish(news.outcome, metrics, report if report.is_file() else None)
        self._ledger.keep(end=end)
        self.problem = ""


def settings_of(folder: RunFolder) -> dict[str, Value]:
    """The settings of a run by their names such as "sky.count". Raises InputError if run.json is none."""
    content = read_json(folder)
    found: dict[str, Value] = {
        name: value if isinstance(value, str | int | float | bool) else str(value)
        for name, value in flat(content.get("config", {}))
    }
    for key, value in content.get("versions", {}).items():
        found[f"versions.{key}"] = str(value)
    found["scene"] = str(content.get("scene", {}).get("path", ""))
    return found


def _points(path: Path, task: str, after: int, until: int) -> list[Point]:
    """The points of all curves of a task in (after, until], by iteration and name.

    Args: path, of run.db; until, at most up to where they are settled. Raises InputError as `reading.query`.
    """
    values = {"task": task, "after": after, "until": until}
    return [Point(*row) for row in query(path, _ROWS, values, timeout_s=_LOCK_S)]
