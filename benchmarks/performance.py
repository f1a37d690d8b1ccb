"""docs/performance.md: all benchmarks run, and the page that says what they found.

    python -m benchmarks.performance --scene FLAT [--model RUN/point_cloud.ply] -o docs/performance.md

About ten minutes on two cores. On a card: `--device cuda -o docs/performance-cuda.md`.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import growth, memory, opensplat, poles, rasterizer, report
from benchmarks.cases import Recipe
from benchmarks.performance_picture import draw
from benchmarks.performance_text import HEADING, READING, SECTIONS
from benchmarks.table import markdown
from panolog.orchestrator.resources.machine import cores
from panolog.scene.files import write_bytes
from panolog.scene.read import read_scene

CARD = (1920, 1_000_000)  # width and Gaussians of the row that only a card has


@dataclass(frozen=True)
class Claim:
    """A goal and what was measured."""

    what: str
    measured: float
    least: float | None = None
    most: float | None = None

    def cells(self) -> tuple[object, ...]:
        """What, goal, measured, met."""
        goal = f"≥ {self.least:g}" if self.least is not None else f"≤ {self.most:g}"
        low, high = self.least or 0.0, float("inf") if self.most is None else self.most
        return (self.what, goal, self.measured, "yes" if low <= self.measured <= high else "no")


@dataclass(frozen=True)
class Section:
    """One benchmark on the page."""

    name: str  # a key of SECTIONS
    body: str  # Markdown
    claims: Sequence[Claim]

    def text(self) -> str:
        """With its heading and its command."""
        title, command, words = SECTIONS[self.name]
        return "\n\n".join([f"## {title}", f"    {command}", words, self.body])


@dataclass(frozen=True)
class Settings:
    """What the page is made of."""

    device: str
    scene: Path  # flat
    model: Path  # trained on it, for the rasterizer
    many: Path  # trained on it, with the Gaussians of the comparison
    quick: bool

    @property
    def repeats(self) -> int:
        return 1 if self.quick else 3

    @property
    def threads(self) -> list[int]:
        """One, and two where there are as many: the goals are stated for those."""
        return [1, 2] if cores() > 1 else [1]


def rasterizer_section(settings: Settings) -> tuple[Section, list[rasterizer.Row]]:
    """Random streets and the trained model at all sizes."""
    widths, counts = ((256,), (5_000,)) if settings.quick else (rasterizer.WIDTHS, rasterizer.COUNTS)
    recipes = [Recipe(width, some) for width in widths for some in counts]
    recipes += [Recipe(width, model=str(settings.model), scene=str(settings.scene)) for width in widths]
    if settings.device == "cuda":
        recipes.append(Recipe(*CARD))
    rows = list(rasterizer.benchmark(recipes, settings.device, settings.threads, settings.repeats))
    trained = [row for row in rows if row.model != "street" and row.width == widths[0]]
    return Section("rasterizer", rasterizer.tables(rows), list(_iteration_claims(trained))), rows


def _iteration_claims(rows: Sequence[rasterizer.Row]) -> Iterator[Claim]:
    """Args: rows of one model, on one thread and, where there are two, on two."""
    first, last = rows[0], rows[-1]
    where = f"trained model at {last.width}×{last.height}"
    yield Claim(f"share of rasterization in an iteration, {where}", last.times.share, least=0.7)
    if last.threads > first.threads:
        gain = first.times.iteration / last.times.iteration
        yield Claim(f"speed-up of two threads, {where}", gain, least=1.8)
    for name, least in {"forward": 0.40, "backward": 0.35}.items():
        share = last.shares()[f"{name}_of_ceiling"]
        if share is not None:
            yield Claim(f"{name}: share of the ceiling in useful pairs, {where}", share, least=least)
    for name, share in zip(("forward", "backward"), last.composited() or (), strict=False):
        least = {"forward": 0.40, "backward": 0.35}[name]
        yield Claim(f"{name}, compositing alone: share of the ceiling, {where}", share, least=least)


def opensplat_section(settings: Settings) -> Section:
    """The comparison at both counts."""
    compared = opensplat.cases(read_scene(settings.scene), settings.many, 3)
    rows = opensplat.compare(compared, settings.threads, settings.repeats)
    claims = [
        Claim(f"times OpenSplat's pixels per second, {row.gaussians:,} Gaussians, {row.on}", ratio, goal)
        for row in rows
        if (ratio := row.ratio) is not None and (goal := opensplat.GOALS.get(row.threads)) is not None
    ]
    return Section("opensplat", markdown(opensplat.HEAD, [row.cells() for row in rows]), claims)


def growth_section(settings: Settings) -> tuple[Section, growth.Growth]:
    """Both series."""
    size = growth.QUICK if settings.quick else growth.FULL
    found = growth.growth(size, settings.device, settings.repeats)
    claims = [
        Claim("R² of cost by pixels", found.pixels().r2, least=0.98),
        Claim("R² of cost by Gaussians", found.gaussians().r2, least=0.98),
    ]
    return Section("growth", found.tables(), claims), found


def poles_section(settings: Settings) -> Section:
    """Poles against horizon."""
    count, width = (1_000, 128) if settings.quick else (200_000, 1024)
    rows = poles.compare(count, width, settings.device, 2 * settings.repeats + 1)
    worst = max(ratio for (what, _), ratio in poles.ratios(rows).items() if what == "all")
    claim = Claim("time per useful pair, poles against horizon", worst, most=poles.GOAL)
    return Section("poles", poles.tables(rows), [claim])


def memory_section(settings: Settings) -> Section:
    """The streets of the rasterizer's table: their peaks are known by now."""
    widths, counts = ((128, 256), (500, 2_000)) if settings.quick else (rasterizer.WIDTHS, rasterizer.COUNTS)
    rows = [memory.row(recipe, settings.device, cores()) for recipe in memory.recipes(widths, counts)]
    claim = Claim("peak memory against gsplat's buffers", max(row.ratio for row in rows), most=memory.GOAL)
    return Section("memory", memory.tables(rows), [claim])


def page(settings: Settings, output: Path) -> Iterator[str]:
    """The page in parts; draws its picture beside it."""
    start = time.monotonic()
    first, rows = rasterizer_section(settings)
    second, found = growth_section(settings)
    sections = [first, second, poles_section(settings), memory_section(settings)]
    if settings.device == "cpu":
        sections.insert(1, opensplat_section(settings))
    picture = output.with_suffix(".svg")
    write_bytes(picture, draw(rows, found))
    minutes = (time.monotonic() - start) / 60
    yield HEADING
    yield f"Measured on: {report.sentence(report.machine(settings.device))}; in {minutes:.0f} minutes."
    claims = [claim.cells() for section in sections for claim in section.claims]
    yield markdown(("what", "goal", "measured", "met"), claims)
    yield f"![Parts of an iteration, and how its cost grows]({picture.name})"
    yield READING
    yield from (section.text() for section in sections)


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.performance", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--scene", type=Path, required=True, help="the scene flat, in COLMAP's layout")
    parser.add_argument("--model", type=Path, metavar="PLY", help="trained on it; else one trained now")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/performance.md"))
    report.add_options(parser)
    options = parser.parse_args()

    def work() -> tuple[report.Content, str]:
        with tempfile.TemporaryDirectory() as folder:
            many = Path(folder, "many.ply")
            opensplat.kept_model(many, read_scene(options.scene))
            model = options.model or many
            settings = Settings(options.device, options.scene, model, many, options.quick)
            text = "\n\n".join(page(settings, options.output)) + "\n"
        write_bytes(options.output, text.encode())
        return {"page": str(options.output)}, f"{options.output} is written"

    return report.run("performance", options, work)


if __name__ == "__main__":
    sys.exit(main())
