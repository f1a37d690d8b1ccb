"""How fast a training iteration is, what it is made of, and how near it comes to what the processor can do.

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
from benchmarks.ceiling import Ceiling, ceiling
from benchmarks.iteration import Stages, Times, measure, stages
from benchmarks.memory import PARAMETERS, probe
from benchmarks.pairs import Counts, count
from benchmarks.table import markdown

WIDTHS = (1024, 2048, 3840)
COUNTS = (50_000, 200_000, 1_000_000)
TIMES = (
    *("model", "size", "Gaussians", "on", "forward ms", "loss ms", "backward ms", "Adam ms", "iteration ms"),
    *("rasterization %", "Mpx/s", "speed-up", "peak MB"),
)
PAIRS = (
    *("model", "size", "Gaussians", "on", "pairs/px", "evaluated/useful"),
    *("forward Mpairs/s", "evaluated", "% of ceiling", "backward Mpairs/s", "evaluated", "% of ceiling"),
)
STAGES = (
    *("model", "size", "Gaussians", "on", "project ms", "order ms", "composite ms", "% of ceiling"),
    *("composite back ms", "% of ceiling", "project back ms"),
)


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
    ceiling: Ceiling | None  # of these threads; not on a card
    stages: Stages | None  # likewise

    @property
    def on(self) -> str:
        """Where it ran."""
        if self.device == "cuda":
            return torch.cuda.get_device_name()
        return "1 thread" if self.threads == 1 else f"{self.threads} threads"

    def rates(self) -> dict[str, float]:
        """Per second: pixels of whole iterations, useful and evaluated pairs of each direction."""
        forward, backward = 1e3 / self.times.forward, 1e3 / self.times.backward
        return {
            "pixels": self.width * self.height * 1e3 / self.times.iteration,
            "forward_useful": self.counts.useful * forward,
            "forward_evaluated": self.counts.evaluated * forward,
            "backward_useful": self.counts.useful * backward,
            "backward_evaluated": self.counts.evaluated * backward,
        }

    def shares(self) -> dict[str, float | None]:
        """Useful pairs per second as fractions of the ceilings, and rasterization as one of the iteration."""
        rates, top = self.rates(), self.ceiling
        return {
            "rasterization": self.times.share,
            "forward_of_ceiling": None if top is None else rates["forward_useful"] / top.forward,
            "backward_of_ceiling": None if top is None else rates["backward_useful"] / top.backward,
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
        _, *shares = (share and 100 * share for share in self.shares().values())
        each = (self.counts.useful / (self.width * self.height), self.counts.evaluated / self.counts.useful)
        return (*self.head(), *each, *rates[:2], shares[0], *rates[2:], shares[1])

    def composited(self) -> tuple[float, float] | None:
        """Useful pairs per second of compositing alone, both ways, as fractions of the ceilings."""
        if self.stages is None or self.ceiling is None:
            return None
        forward, backward = self.stages.composite, self.stages.composite_backward
        useful = 1e3 * self.counts.useful
        return useful / forward / self.ceiling.forward, useful / backward / self.ceiling.backward

    def stage_cells(self) -> tuple[object, ...]:
        """In the order of STAGES."""
        spent, shares = self.stages, self.composited()
        if spent is None or shares is None:
            return (*self.head(), *[None] * 7)
        forward = (spent.project, spent.order, spent.composite, 100 * shares[0])
        return (*self.head(), *forward, spent.composite_backward, 100 * shares[1], spent.project_backward)

    def content(self) -> report.Content:
        """For JSON."""
        return asdict(self) | {"on": self.on, "per_second": self.rates(), "shares": self.shares()}


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
            top = ceiling(many) if device == "cpu" else None
            times = measure(case, many, repeats)
            spent = stages(case, many, repeats) if device == "cpu" else None
            yield Row(case.name, *size, gaussians, device, many, counts, times, memory, top, spent)


def tables(rows: Sequence[Row]) -> str:
    """Tables in Markdown: times, pairs, and on the CPU the stages."""
    slowest: dict[tuple[object, ...], float] = {}
    cells = []
    for row in rows:
        first = slowest.setdefault(row.head()[:3], row.times.iteration)
        cells.append(row.time_cells(first / row.times.iteration if row.times.iteration != first else None))
    parts = [markdown(TIMES, cells), markdown(PAIRS, [row.pair_cells() for row in rows])]
    inside = [row.stage_cells() for row in rows if row.stages is not None]
    return "\n\n".join([*parts, markdown(STAGES, inside)] if inside else parts)


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
