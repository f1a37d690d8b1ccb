"""How fast a training iteration is, and what it is made of.

    python -m benchmarks.rasterizer [--width 1024,2048] [--gaussians 50000,200000] [--threads 1,2] [--json]
    python -m benchmarks.rasterizer --model RUN/point_cloud.ply --scene SCENE [-o docs/performance.md]
    python -m benchmarks.rasterizer --projection both
    python -m benchmarks.rasterizer --block far,middle --width 1024 --gaussians 1000000
    python -m benchmarks.rasterizer --device cuda --width 1920 --gaussians 1000000

Each time is the median of several repetitions after a warm-up.
"""

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks import report
from benchmarks.rasterizer.cases import BLOCKS, CaseSpec
from benchmarks.rasterizer.page import page
from benchmarks.rasterizer.rows import COUNTS, WIDTHS, benchmark, tables
from panolog.orchestrator.runs.machines.machine import cores
from panolog.renderer.process import choose_device, prepare
from panolog.scene.files import write_bytes


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = report.parser("rasterizer", __doc__)
    parser.add_argument("--device", default="cpu", help="cpu, cuda or auto")
    parser.add_argument("--width", type=report.numbers, default=list(WIDTHS), help="separated by commas")
    parser.add_argument("--gaussians", type=report.numbers, help="of random streets; none with a --model")
    parser.add_argument("--model", metavar="PLY", help="a trained model; needs --scene")
    parser.add_argument("--scene", help="the scene that the model was trained on")
    parser.add_argument("--projection", choices=("affine", "exact", "both"), default="affine")
    parser.add_argument(
        "--block",
        type=lambda text: text.split(","),
        default=[None],
        help="train an eighth of each model, at the end or in the middle along x, the rest baked: far,middle",
    )
    parser.add_argument("--views", type=int, default=3, help="training panoramas to time a model on")
    parser.add_argument("--threads", type=report.numbers, default=[1, 2] if cores() > 1 else [1])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, metavar="PAGE", help="write docs/performance.md here")
    options = parser.parse_args(arguments)
    if not {None, *BLOCKS} >= set(options.block):
        parser.error(f"--block takes {' and '.join(BLOCKS)}, separated by a comma")
    if options.gaussians is None:
        options.gaussians = list(COUNTS) if options.model is None else []
    if options.quick:
        options.width, options.gaussians, options.repeats, options.views = [256], [5_000], 1, 1
    return options


def specs(options: argparse.Namespace) -> Iterator[CaseSpec]:
    """The cases that the options request."""
    projections = ("affine", "exact") if options.projection == "both" else (options.projection,)
    for width, projection, block in itertools.product(options.width, projections, options.block):
        kind = CaseSpec(width, exact=projection == "exact", block=block)
        yield from (replace(kind, count=gaussians) for gaussians in options.gaussians)
        if options.model is not None or options.scene is not None:
            yield replace(kind, model=options.model, scene=options.scene, views=options.views)


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    options = parse(arguments)

    def work() -> report.Report:
        options.device = choose_device(options.device)
        prepare(cores())  # freed memory is kept between iterations, as in a training worker
        rows = list(benchmark(specs(options), options.device, options.threads, options.repeats))
        if options.output is not None:
            write_bytes(options.output, page(rows).encode())
        return report.Report({"rows": [row.content() for row in rows]}, tables(rows))

    return report.run("rasterizer", options, work)


if __name__ == "__main__":
    sys.exit(main())
