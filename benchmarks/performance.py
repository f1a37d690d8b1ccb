"""docs/performance.md: the rasterizer's benchmark on random streets and on a trained model, with its goals.

    python -m benchmarks.performance --scene FLAT --model RUN/point_cloud.ply -o docs/performance.md

About five minutes on two cores. On a GPU: `--device cuda -o docs/performance-cuda.md`, where scene and
model may be left out: the random streets need no data.
"""

import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import jinja2

from benchmarks import report
from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.rows import COUNTS, TIMES, WIDTHS, Row, benchmark, tables
from panolog.orchestrator.runs.machines.machine import cores
from panolog.renderer.process import choose_device, prepare
from panolog.scene.files import write_bytes

GPU_ONLY = (1920, 1_000_000)  # width and Gaussians of a row that only a GPU has
TEMPLATE = Path(__file__).with_name("performance.md.j2")
# Columns of the summary.
_SUMMARY = ("model", "size", "Gaussians", "on", "iteration ms", "speed-up", "peak MB")


def goals(rows: Sequence[Row]) -> Iterator[tuple[object, ...]]:
    """What, goal, measured, met. Args: rows of one model and size, on one thread and, if possible, on two."""
    last = rows[-1]
    where = f"trained model at {last.width}×{last.height}"
    yield _goal(f"share of rasterization and Adam in an iteration, {where}", 0.7, last.times.share)
    if last.speed_up is not None:
        yield _goal(f"speed-up of two threads, {where}", 1.8, last.speed_up)


def summary(rows: Sequence[Row]) -> str:
    """The table of the rows that most readers look for: most threads, of the street most Gaussians."""
    most = max(row.threads for row in rows)
    largest = max((row.gaussians for row in rows if row.model == "street"), default=0)
    chosen = [row for row in rows if row.model != "street" or row.gaussians == largest]
    cells = [cell for name, cell in TIMES if name in _SUMMARY]
    return report.markdown(_SUMMARY, [[cell(row) for cell in cells] for row in chosen if row.threads == most])


def _goal(what: str, least: float, measured: float) -> tuple[object, ...]:
    return what, f"≥ {least:g}", measured, "yes" if measured >= least else "no"


def measure(
    scene: Path | None, model: Path | None, device: str, *, quick: bool, seconds: float = math.inf
) -> Iterator[Row]:
    """The rows of the page, those of a trained model if there is one.

    Args: seconds, after which no further row is measured. Raises InputError if scene or model cannot be read.
    """
    ends = time.monotonic() + seconds
    widths, counts = ((256,), (5_000,)) if quick else (WIDTHS, COUNTS)
    specs = [CaseSpec(width, count) for width in widths for count in counts]
    if scene is not None and model is not None:
        specs += [CaseSpec(width, model=str(model), scene=str(scene)) for width in widths]
    if device == "cuda" and not quick:
        specs.insert(0, CaseSpec(*GPU_ONLY))
    threads = [1, 2] if cores() > 1 else [1]  # the goals are stated for two
    for row in benchmark(specs, device, threads, 1 if quick else 3):
        yield row
        if time.monotonic() > ends:
            return


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


def main() -> int:
    """The program; returns its exit code."""
    parser = report.parser("performance", __doc__)
    parser.add_argument("--device", default="cpu", help="cpu, cuda or auto")
    parser.add_argument("--scene", type=Path, help="the scene flat, in COLMAP's layout")
    parser.add_argument("--model", type=Path, metavar="PLY", help="trained on the scene")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/performance.md"))
    options = parser.parse_args()
    if (options.model is None) != (options.scene is None):
        parser.error("--model and --scene go together")

    def work() -> report.Report:
        options.device = choose_device(options.device)
        prepare(cores())
        rows = list(measure(options.scene, options.model, options.device, quick=options.quick))
        write_bytes(options.output, page(rows).encode())
        return report.Report({"page": str(options.output)}, f"wrote {options.output}")

    return report.run("performance", options, work)


if __name__ == "__main__":
    sys.exit(main())
