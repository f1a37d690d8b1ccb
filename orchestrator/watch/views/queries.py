"""Queries of run.db for the pages, by its indexes: no more rows than are shown, but for bounded searches.

A run has few records besides those of progress, and those are read through an index of their own or from the
end of the table.
"""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from panolog.orchestrator.runs.database import EVENT, MILESTONE, PICTURES
from panolog.orchestrator.runs.sql import has_table, query

LOCK_TIMEOUT_S = 5.0  # to wait for the driver, which locks the database for milliseconds
SEARCHED = 50_000  # records that one search for a text reads
_query = partial(query, timeout_s=LOCK_TIMEOUT_S)
_Item = TypeVar("_Item")
_VIEWS = 2_000  # held-out panoramas of which the best is found
_PREVIEWS = 200  # of a task, at most
# The parts of the table that have an index by task, or are small.
_KINDS = ("type = 'Progressed'", "type = 'CheckpointSaved'", PICTURES, MILESTONE)
_NAMES = """
WITH RECURSIVE names(name) AS (
    SELECT MIN(name) FROM metrics WHERE task = :task
    UNION ALL
    SELECT (SELECT MIN(m.name) FROM metrics m WHERE m.task = :task AND m.name > names.name) FROM names
    WHERE names.name IS NOT NULL)
SELECT name FROM names WHERE name IS NOT NULL
"""
# The last row of each of `points` equal ranges of iterations. Of iterations that were repeated after a
# failure the later row counts, and those beyond the checkpoint are left out until they are repeated.
_SERIES = """
WITH span(low, high) AS (
    SELECT (SELECT MIN(iteration) FROM metrics WHERE task = :task AND name = :name),
           (SELECT MAX(iteration) FROM metrics WHERE task = :task AND name = :name)),
thin(row, iteration) AS (
    SELECT MAX(metrics.rowid), MAX(iteration) FROM metrics, span WHERE task = :task AND name = :name
    GROUP BY (iteration - low) * :points / (high - low + 1)),
kept(row) AS (
    SELECT row FROM (SELECT row, MAX(row) OVER (ORDER BY iteration) AS newest FROM thin) WHERE row = newest)
SELECT iteration, time, value FROM metrics WHERE rowid IN kept ORDER BY iteration
"""


@dataclass(frozen=True)
class Filter:
    """Which events to return."""

    before: int | None = None  # ids below this
    after: int = 0  # and above this
    types: frozenset[str] = frozenset()  # empty = all
    without: frozenset[str] = frozenset()
    task: str | None = None
    text: str = ""  # somewhere in the record, in either case


def spread(items: Sequence[_Item], most: int) -> list[_Item]:
    """At most `most` of the items, two or more, evenly spaced, both ends included."""
    if len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


def series(
    path: Path, task: str, points: int, only: Collection[str] | None = None
) -> dict[str, dict[str, list[float]]]:
    """The curves of a task by name, at most `points` rows of each: iterations, epoch seconds, values.

    Args: only, the names that are wanted; by default all.
    Raises InputError as `reading.query`.
    """
    names = [name for (name,) in _query(path, _NAMES, {"task": task})]
    names = [name for name in names if only is None or name in only]
    curves = {}
    for name in names:
        rows = _query(path, _SERIES, {"task": task, "name": name, "points": points})
        curves[name] = {
            "iteration": [row[0] for row in rows],
            "time": [row[1] for row in rows],
            "value": [row[2] for row in rows],
        }
    return curves


def events(path: Path, wanted: Filter, limit: int) -> dict[str, Any]:
    """The newest matching events, newest first, whether there may be more, and `before` for those.

    A search for a text stops after SEARCHED records, perhaps without any event, but with `more`.
    Raises InputError as `reading.query`, ValueError if a record is no JSON.
    """
    before = wanted.before
    if wanted.text:
        rows, oldest = _search(path, wanted, limit)
        more = oldest is not None
    else:
        rows = _page(path, wanted, limit + 1)
        more, rows = len(rows) > limit, rows[:limit]
        oldest = rows[-1][0] if rows else before
    return {"events": [_event(row) for row in rows], "more": more, "next": oldest if more else None}


def previews(path: Path, task: str | None = None) -> list[dict[str, Any]]:
    """The latest previews: of one task newest first, or without `task` the latest of each task."""
    kind = f"{PICTURES} AND type = 'PreviewSaved'"
    if task is not None:
        sql = f"{EVENT} WHERE {kind} AND task = ? ORDER BY id DESC LIMIT ?"
        rows = _query(path, sql, (task, _PREVIEWS))
    else:
        sql = f"SELECT MAX(id) FROM events WHERE {kind} GROUP BY task"
        rows = _query(path, f"{EVENT} WHERE id IN ({sql}) ORDER BY task")
    return [_event(row) for row in rows]


def views(path: Path, most: int) -> list[dict[str, Any]]:
    """The latest comparisons of held-out panoramas, of whichever task, newest first."""
    last = f"SELECT id FROM events INDEXED BY pictures WHERE {PICTURES} AND type = 'ViewEvaluated'"
    sql = f"{EVENT} WHERE id IN ({last} ORDER BY id DESC LIMIT ?) ORDER BY id DESC"
    return [_event(row) for row in _query(path, sql, (most,))]


def cover(path: Path, *, evaluated: bool) -> int | None:
    """The id of the comparison of the best held-out panorama, or of the latest picture of a training.

    Args: evaluated, whether all comparisons have been made.
    Raises InputError as `reading.query`, ValueError if a record is no JSON.
    """
    if not path.exists():
        return None
    if evaluated and (found := views(path, _VIEWS)):
        return int(max(found, key=lambda event: (event.get("metrics") or {}).get("psnr") or 0.0)["id"])
    rows = _query(path, f"SELECT MAX(id) FROM events WHERE {PICTURES}")
    return rows[0][0] if rows else None


def usages(path: Path) -> dict[str, dict[str, Any]]:
    """What each machine did when it was last measured, with `time` in epoch seconds.

    Raises InputError as `reading.query`, ValueError if a row is no JSON object.
    """
    if not has_table(path, "nodes", timeout_s=LOCK_TIMEOUT_S):  # of an older version
        return {}
    rows = _query(path, "SELECT node, time, usage FROM nodes")
    return {node: {**json.loads(text), "time": time} for node, time, text in rows}


def event(path: Path, number: int, kind: str) -> dict[str, Any] | None:
    """One event by its id, if there is one of that type."""
    rows = _query(path, f"{EVENT} WHERE id = ? AND type = ?", (number, kind))
    return _event(rows[0]) if rows else None


def _page(path: Path, wanted: Filter, limit: int) -> list[tuple[Any, ...]]:
    """The newest `limit` rows, newest first; each kind of record by its own index."""
    bounds, values = _bounds(wanted)
    if wanted.task is None and not wanted.types:
        sql = f"{EVENT} WHERE {bounds} ORDER BY id DESC LIMIT ?"
        return _query(path, sql, (*values, limit))
    part = f"SELECT * FROM ({EVENT} WHERE {{}} AND {bounds} ORDER BY id DESC LIMIT ?)"
    sql = " UNION ALL ".join(part.format(kind) for kind in _KINDS) + " ORDER BY id DESC LIMIT ?"
    return _query(path, sql, (*(*values, limit) * len(_KINDS), limit))


def _search(path: Path, wanted: Filter, limit: int) -> tuple[list[tuple[Any, ...]], int | None]:
    """The rows, and the id before which to continue: None if there is nothing older."""
    window = _page(path, wanted, SEARCHED)
    text = wanted.text.casefold()
    found = [row for row in window if text in str(row[2]).casefold() or text in str(row[3]).casefold()]
    if len(found) > limit:
        return found[:limit], found[limit - 1][0]
    return found, window[-1][0] if len(window) == SEARCHED else None


def _bounds(wanted: Filter) -> tuple[str, tuple[Any, ...]]:
    """The conditions on id, type and task, and their values."""
    parts, values = ["id > ?"], [wanted.after]
    given: list[tuple[str, Sequence[Any]]] = [
        ("id < ?", () if wanted.before is None else (wanted.before,)),
        ("task = ?", () if wanted.task is None else (wanted.task,)),
        (f"type IN ({_marks(wanted.types)})", sorted(wanted.types)),
        (f"type NOT IN ({_marks(wanted.without)})", sorted(wanted.without)),
    ]
    for condition, its_values in given:
        if its_values:
            parts.append(condition)
            values += its_values
    return " AND ".join(parts), tuple(values)


def _marks(values: frozenset[str]) -> str:
    return ", ".join("?" * len(values))


def _event(row: Sequence[Any]) -> dict[str, Any]:
    number, time, kind, payload = row
    fields = json.loads(payload)
    if not isinstance(fields, dict):
        raise ValueError(f"event {number} is not a JSON object")
    return fields | {"id": number, "time": time, "type": kind}
