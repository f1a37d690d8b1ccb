"""How the cost of an iteration grows with pixels and with Gaussians.

    python -m benchmarks.growth [--repeats 5] [--json]

Random streets. More pixels: the same Gaussians, each over as many more pixels, so pairs per pixel stay.
More Gaussians: each is smaller, as its neighbours are nearer, so pairs per pixel stay about the same until
footprints are as small as a pixel; what grows is the work for each Gaussian and for each tile that it
meets.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks import report
from benchmarks.cases import Recipe
from benchmarks.fit import Fit, fit
from benchmarks.iteration import measure
from benchmarks.pairs import count
from benchmarks.table import markdown
from panolog.orchestrator.resources.machine import cores

HEAD = ("size", "Gaussians", "pairs/px", "iteration ms")


@dataclass(frozen=True)
class Series:
    """What is measured: `count` Gaussians at all widths, and `width` pixels with all counts."""

    widths: Sequence[int]
    count: int
    counts: Sequence[int]
    width: int


FULL = Series(
    widths=(512, 1024, 1536, 2048, 2880, 3840),
    count=200_000,
    counts=(25_000, 50_000, 100_000, 200_000, 400_000, 1_000_000),
    width=1024,
)
QUICK = Series(widths=(64, 128, 192), count=1_000, counts=(500, 1_000, 2_000), width=128)


@dataclass(frozen=True)
class Point:
    """The cost of an iteration on one street."""

    width: int
    pixels: int
    gaussians: int
    pairs: float  # useful
    milliseconds: float

    def cells(self) -> tuple[object, ...]:
        """In the order of HEAD."""
        size = f"{self.width}×{self.pixels // self.width}"
        return (size, self.gaussians, self.pairs / self.pixels, self.milliseconds)


@dataclass(frozen=True)
class Growth:
    """Both series with their lines; milliseconds for a million of each."""

    by_pixels: tuple[Point, ...]
    by_gaussians: tuple[Point, ...]

    def pixels(self) -> Fit:
        """Cost by pixels."""
        return _line(self.by_pixels, "pixels")

    def gaussians(self) -> Fit:
        """Cost by Gaussians."""
        return _line(self.by_gaussians, "gaussians")

    def work(self) -> Fit:
        """Cost of all points by Gaussians and useful pairs together."""
        return _line(self.by_pixels + self.by_gaussians, "gaussians", "pairs")

    def fits(self) -> dict[str, Fit]:
        """By name."""
        return {"pixels": self.pixels(), "gaussians": self.gaussians(), "work": self.work()}

    def tables(self) -> str:
        """Points and lines in Markdown."""
        points = [point.cells() for point in (*self.by_pixels, *self.by_gaussians)]
        lines = [(_formula(fit), fit.r2) for fit in self.fits().values()]
        return markdown(HEAD, points) + "\n\n" + markdown(("iteration in ms", "R²"), lines)

    def content(self) -> dict[str, Any]:
        """All of it for JSON."""
        return asdict(self) | {"fits": {name: asdict(fit) for name, fit in self.fits().items()}}


def _line(points: Sequence[Point], *columns: str) -> Fit:
    values = {name: [getattr(point, name) / 1e6 for point in points] for name in columns}
    return fit(values, [point.milliseconds for point in points])


def _formula(line: Fit) -> str:
    terms = [f"{slope:.3g} · M {name}" for name, slope in line.slopes.items()]
    return " + ".join([f"{line.constant:.3g}", *terms])


def growth(series: Series, device: str, repeats: int) -> Growth:
    """Measures both."""
    return Growth(
        tuple(_point(Recipe(width, series.count), device, repeats) for width in series.widths),
        tuple(_point(Recipe(series.width, count), device, repeats) for count in series.counts),
    )


def _point(recipe: Recipe, device: str, repeats: int) -> Point:
    case = recipe.make()
    pixels, gaussians = case.shots[0].pixels, len(case.gaussians)
    pairs = count(case).useful
    return Point(recipe.width, pixels, gaussians, pairs, measure(case.to(device), cores(), repeats).iteration)


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.growth", description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    report.add_options(parser)
    options = parser.parse_args()

    def work() -> tuple[report.Content, str]:
        found = growth(QUICK if options.quick else FULL, options.device, options.repeats)
        return found.content(), found.tables()

    return report.run("growth", options, work)


if __name__ == "__main__":
    sys.exit(main())
