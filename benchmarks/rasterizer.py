"""How fast a training iteration is, what it is made of.

    python -m benchmarks.rasterizer [--width 1024,2048] [--gaussians 50000,200000] [--threads 1,2] [--json]
    python -m benchmarks.rasterizer --model RUN/point_cloud.ply --scene SCENE
    python -m benchmarks.rasterizer --device cuda --width 1920 --gaussians 1000000

Each time is the median of several repetitions after a warm-up.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks import report
from benchmarks.cases import Recipe
from benchmarks.iteration import Times, measure
from benchmarks.memory import PARAMETERS, probe
from benchmarks.pairs import Counts, count
from benchmarks.table import markdown

WIDTHS = (1024, 2048, 3840)
COUNTS = (50_000, 200_000, 1_000_000)
TIMES = (
    *("model", "size", "Gaussians", "on", "forward ms", "loss ms", "backward ms", "Adam ms", "iteration ms"),
    *("rasterization %", "Mpx/s", "speed-up", "peak MB"),
)
PAIRS = (*("model", "size", "Gaussians", "on", "pairs/px", "forward Mpairs/s", "backward Mpairs/s"),)


@dataclass(frozen=True)
class Row:
    """A case at a number of threads, or on a card; means over its images."""

    model: str
    width: int  # pixels
    height: int
    gaussians: int
    device: str  # "cpu" or "cuda"
    threads: int  # of the host
    counts: Counts
    times: Times
    memory: int  # bytes at the peak of an iteration: model, moments, target, image and all buffers

    @property
    def on(self) -> str:
        """Where it ran."""
        if self.device == "cuda":
            return torch.cuda.get_device_name()
        return "1 thread" if self.threads == 1 else f"{self.threads} threads"

    def rates(self) -> dict[str, float]:
        """Per second: pixels of whole iterations, useful pairs of each direction."""
        forward, backward = 1e3 / self.times.forward, 1e3 / self.times.backward
        return {
            "pixels": self.width * self.height * 1e3 / self.times.iteration,
            "forward_useful": self.counts.useful * forward,
            "backward_useful": self.counts.useful * backward,
        }

    def head(self) -> tuple[object, ...]:
        """Which row it is."""
        return (self.model, f"{self.width}×{self.height}", self.gaussians, self.on)

    def time_cells(self, speed_up: float | None) -> tuple[object, ...]:
        """In the order of TIMES."""
        times = self.times
        parts = (times.forward, times.loss, times.backward, times.adam, times.iteration)
        return (
            *self.head(),
            *parts,
            100 * times.share,
            self.rates()["pixels"] / 1e6,
            speed_up,
            self.memory / 1e6,
        )

    def pair_cells(self) -> tuple[object, ...]:
        """In the order of PAIRS."""
        _, *rates = (rate / 1e6 for rate in self.rates().values())
        return (*self.head(), self.counts.useful / (self.width * self.height), *rates)

    def content(self) -> report.Content:
        """For JSON."""
        return asdict(self) | {"on": self.on, "per_second": self.rates(), "rasterization": self.times.share}


def benchmark(recipes: Iterable[Recipe], device: str, threads: Sequence[int], repeats: int) -> Iterator[Row]:
    """One row for each case and number of threads; one for each case on a card."""
    for recipe in recipes:
        case = recipe.make()
        camera, counts = case.shots[0].camera, count(case)
        size, gaussians = (camera.width, camera.height), len(case.gaussians)
        case = case.to(device)
        state = 3 * PARAMETERS * gaussians + 3 * camera.width * camera.height  # with both moments; the target
        for many in threads if device == "cpu" else threads[-1:]:
            memory = state + probe(recipe, device, many).iteration
            times = measure(case, many, repeats)
            yield Row(case.name, *size, gaussians, device, many, counts, times, memory)


def tables(rows: Sequence[Row]) -> str:
    """Two tables in Markdown: times, and pairs."""
    slowest: dict[tuple[object, ...], float] = {}
    cells = []
    for row in rows:
        first = slowest.setdefault(row.head()[:3], row.times.iteration)
        cells.append(row.time_cells(first / row.times.iteration if row.times.iteration != first else None))
    return markdown(TIMES, cells) + "\n\n" + markdown(PAIRS, [row.pair_cells() for row in rows])


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rasterizer", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--width", type=report.numbers, default=list(WIDTHS), help="a comma between two")
    parser.add_argument("--gaussians", type=report.numbers, help="of random streets; none beside a --model")
    parser.add_argument("--model", type=Path, metavar="PLY", help="a trained model; needs --scene")
    parser.add_argument("--scene", type=Path, help="the scene that the model was trained on")
    parser.add_argument("--views", type=int, default=3, help="training panoramas to time a model on")
    parser.add_argument("--threads", type=report.numbers, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)
    report.add_options(parser)
    parsed = parser.parse_args(arguments)
    if (parsed.model is None) != (parsed.scene is None):
        parser.error("--model and --scene go together")
    if parsed.gaussians is None:
        parsed.gaussians = list(COUNTS) if parsed.model is None else []
    if parsed.quick:
        parsed.width, parsed.gaussians, parsed.repeats, parsed.views = [256], [5_000], 1, 1
    return parsed


def recipes_of(options: argparse.Namespace) -> Iterator[Recipe]:
    """What the options ask for."""
    for width in options.width:
        yield from (Recipe(width, gaussians) for gaussians in options.gaussians)
        if options.model is not None:
            yield Recipe(width, model=str(options.model), scene=str(options.scene), views=options.views)


def main() -> int:
    """The program; returns its exit code."""
    options = parse()

    def work() -> tuple[report.Content, str]:
        found = benchmark(recipes_of(options), options.device, options.threads, options.repeats)
        rows = list(found)
        return {"rows": [row.content() for row in rows]}, tables(rows)

    return report.run("rasterizer", options, work)


if __name__ == "__main__":
    sys.exit(main())
