"""The peak memory of one forward and backward pass, beside what gsplat's buffers need for the same counts.

python -m benchmarks.memory [--width 1024,2048] [--gaussians 50000,200000,1000000] [--json]
"""

import argparse
import functools
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks import report
from benchmarks.cases import Recipe
from benchmarks.fit import Fit, fit
from benchmarks.memory_probe import ENVIRONMENT, Peaks
from benchmarks.pairs import Counts, count
from benchmarks.table import markdown
from panolog.orchestrator.resources.machine import cores
from panolog.scene.errors import RunError

GOAL = 1.5  # times gsplat's
GSPLAT_TILE = 16  # pixels
PARAMETERS = 59 * 4  # bytes of a Gaussian
HEAD = ("size", "Gaussians", "visible", "entries", "peak MB", "bytes/Gaussian", "gsplat MB", "ratio")


@functools.cache
def probe(recipe: Recipe, device: str, threads: int) -> Peaks:
    """The peaks of a case, measured in a process of its own. Raises RunError if that fails."""
    asked = json.dumps({"device": device, "threads": threads, "recipe": asdict(recipe)})
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.memory_probe", asked],
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RunError(f"the memory of {recipe} was not measured: {done.stderr.strip()[-300:]}")
    return Peaks(**json.loads(done.stdout))


def gsplat_bytes(gaussians: float, visible: float, entries: float, width: int, height: int) -> float:
    """The least that gsplat 1.5 holds at the peak of a forward and backward pass; a count, not a measurement.

    From the tensors that `rasterization(packed=True, render_mode="RGB+D", sh_degree=3)` in rendering.py,
    cuda/csrc/Intersect.cpp and the autograd functions of cuda/_wrapper.py allocate: colour and depth of one
    camera, float32 and int32 unless said otherwise. Left out, in its favour: what torch's own operators take
    for themselves, the concatenation of the SH coefficients before the call, and the activations of the
    parameters.

    For each visible Gaussian (nnz):
        ids       batch_ids, camera_ids, gaussian_ids, image_ids (int64)         32
        splat     radii (2), means2d (2), depths, conics (3), opacities          36
        tiles     tiles_per_gauss                                                 4
        colour    dirs (3), mask (bool), colours (3) before the clamp, (4) after  41
        sh        the gathered coefficients (16, 3)                             192
    For each entry, a splat in a tile:
        isect_ids (int64), flatten_ids: 12; twice that while they are sorted, with cum_tiles_per_gauss (int64)
    For each tile: isect_offsets, 4. For each pixel: colours (4), alphas, last_ids: 24; gradients of the first
    two: 20. Gradients of the parameters, dense: 236 for each Gaussian.

    Four moments are candidates for the peak; it is the largest of them.
    """
    pixels = width * height
    tiles = math.ceil(width / GSPLAT_TILE) * math.ceil(height / GSPLAT_TILE)
    ids, splat, counts, color, sh = 32, 36, 4, 41, 192
    splat_gradients = 28  # of means2d, conics, depths, opacities
    kept = ids + splat + counts
    sorting = visible * (kept + color + sh + 8) + entries * 24
    images = tiles * 4 + entries * 12
    compositing = images + visible * (kept + color + sh + splat_gradients + 16) + pixels * 44
    # the gathered coefficients and their gradients; from here on the loss's gradients are gone
    harmonics = images + visible * (kept + 13 + 2 * sh + splat_gradients + 24) + pixels * 20
    scattering = images + visible * (kept + sh + splat_gradients + 12) + gaussians * sh + pixels * 20
    done = images + visible * (kept + 8) + gaussians * PARAMETERS + pixels * 20
    return max(sorting, compositing, harmonics, scattering, done)


@dataclass(frozen=True)
class Row:
    """One case: the measured peak, the counted one of gsplat."""

    width: int
    height: int
    gaussians: int
    counts: Counts
    peak: int  # bytes
    gsplat: float  # bytes

    @property
    def ratio(self) -> float:
        return self.peak / self.gsplat

    def cells(self) -> tuple[object, ...]:
        """In the order of HEAD."""
        counted = (round(self.counts.visible), round(self.counts.entries))
        size = f"{self.width}×{self.height}"
        each = round(self.peak / self.gaussians)
        return (size, self.gaussians, *counted, self.peak / 1e6, each, self.gsplat / 1e6, self.ratio)


def row(recipe: Recipe, device: str, threads: int) -> Row:
    """Measures one case."""
    case = recipe.make()
    camera, gaussians, counts = case.shots[0].camera, len(case.gaussians), count(case)
    size = (camera.width, camera.height)
    needed = gsplat_bytes(gaussians, counts.visible, counts.entries, *size)
    return Row(*size, gaussians, counts, probe(recipe, device, threads).rasterization, needed)


def laws(rows: Sequence[Row]) -> Fit:
    """Bytes as a constant and a multiple of Gaussians, pixels and entries."""
    columns: dict[str, list[float]] = {
        "Gaussian": [row.gaussians for row in rows],
        "pixel": [row.width * row.height for row in rows],
        "entry": [row.counts.entries for row in rows],
    }
    return fit(columns, [row.peak for row in rows])


def tables(rows: Sequence[Row]) -> str:
    """The rows, the fit and the verdict, in Markdown."""
    law, worst = laws(rows), max(row.ratio for row in rows)
    each = ", ".join(f"{value:.0f} per {name}" for name, value in law.slopes.items())
    return "\n\n".join(
        [
            markdown(HEAD, [row.cells() for row in rows]),
            f"Bytes of the peak: {each} (R² {law.r2:.4f}).",
            f"At most {worst:.2f} times gsplat's buffers (goal: {GOAL}).",
        ]
    )


def content(rows: Iterable[Row]) -> dict[str, Any]:
    """All of it for JSON."""
    rows = list(rows)
    return {"rows": [asdict(row) | {"ratio": row.ratio} for row in rows], "fit": asdict(laws(rows))}


def recipes(widths: Sequence[int], counts: Sequence[int]) -> list[Recipe]:
    """Random streets."""
    return [Recipe(width, count) for width in widths for count in counts]


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.memory", description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=report.numbers, default=[1024, 2048])
    parser.add_argument("--gaussians", type=report.numbers, default=[50_000, 200_000, 1_000_000])
    parser.add_argument("--threads", type=int, default=cores())
    report.add_options(parser)
    options = parser.parse_args()
    if options.quick:
        options.width, options.gaussians = [128, 256], [500, 2_000]

    def work() -> tuple[report.Content, str]:
        asked = recipes(options.width, options.gaussians)
        rows = [row(recipe, options.device, options.threads) for recipe in asked]
        return content(rows), tables(rows)

    return report.run("memory", options, work)


if __name__ == "__main__":
    sys.exit(main())
