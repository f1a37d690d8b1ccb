"""docs/performance.md, from the rows of the rasterizer's benchmark, with its goals first."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import jinja2

from benchmarks import report
from benchmarks.rasterizer.rows import TIMES, Row, tables

TEMPLATE = Path(__file__).with_suffix(".md.j2")
# Columns of the summary.
_SUMMARY = ("model", "size", "Gaussians", "on", "iteration ms", "speed-up", "peak MB")


def goals(rows: Sequence[Row]) -> Iterator[tuple[object, ...]]:
    """What, goal, measured, met. Args: rows of one model and size, on one thread and, if possible, on two."""
    last = rows[-1]
    where = f"trained model at {last.width}×{last.height}"
    yield _goal(f"share of rasterization and Adam in an iteration, {where}", 0.7, last.times.share)
    if last.speed_up is not None:
        yield _goal(f"speed-up of two threads, {where}", 1.8, last.speed_up)


def _goal(what: str, least: float, measured: float) -> tuple[object, ...]:
    return what, f"≥ {least:g}", measured, "yes" if measured >= least else "no"


def summary(rows: Sequence[Row]) -> str:
    """The table of the rows that most readers look for: most threads, of the street most Gaussians."""
    most = max(row.threads for row in rows)
    largest = max((row.gaussians for row in rows if row.model == "street"), default=0)
    chosen = [row for row in rows if row.model != "street" or row.gaussians == largest]
    cells = [cell for name, cell in TIMES if name in _SUMMARY]
    return report.markdown(_SUMMARY, [[cell(row) for cell in cells] for row in chosen if row.threads == most])


def page(rows: Sequence[Row]) -> str:
    """The page in Markdown."""
    trained = [row for row in rows if row.model != "street"]
    narrow = [row for row in trained if row.width == min(row.width for row in trained)]
    template = jinja2.Template(TEMPLATE.read_text(), trim_blocks=True, keep_trailing_newline=True)
    written: str = template.render(
        on_cpu=rows[0].device == "cpu",
        measured_on=report.sentence(report.machine(rows[0].device)),
        summary=summary(rows),
        goals=report.markdown(("what", "goal", "measured", "met"), list(goals(narrow))) if narrow else "",
        count=len(rows),
        tables=tables(rows),
    )
    return written
