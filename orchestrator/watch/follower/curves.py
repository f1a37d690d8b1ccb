"""The settled part of a run's curves, as run.db has them in the end: each iteration once.

After a failure a task continues from its latest checkpoint, and iterations that follow it come again. A row
counts only if no row of an earlier iteration is newer; up to a checkpoint no newer rows will come.
"""

from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.runs.reading import query

_ROWS = """
WITH thin AS (
    SELECT name, iteration, MAX(rowid) AS row FROM metrics
    WHERE task = :task AND iteration <= :until GROUP BY name, iteration),
kept AS (SELECT row, iteration, MAX(row) OVER (PARTITION BY name ORDER BY iteration) AS newest FROM thin)
SELECT name, iteration, time, value FROM metrics
WHERE rowid IN (SELECT row FROM kept WHERE row = newest AND iteration > :after) ORDER BY iteration, name
"""
_TIMEOUT_S = 5.0  # to wait for the driver's lock


@dataclass(frozen=True)
class Point:
    """One value of a curve."""

    name: str  # of the curve: loss, psnr, …
    iteration: int
    time: float  # seconds since the epoch
    value: float


def points(path: Path, task: str, after: int, until: int) -> list[Point]:
    """The points of all curves of a task in (after, until], by iteration and name.

    Args: path, of run.db; until, at most up to where they are settled. Raises InputError as `reading.query`.
    """
    values = {"task": task, "after": after, "until": until}
    return [Point(*row) for row in query(path, _ROWS, values, timeout_s=_TIMEOUT_S)]
