"""Whether Gaussians at the poles cost more than their pixels do: one in twenty there, or at the horizon.

    python -m benchmarks.poles [--width 1024] [--gaussians 200000] [--json]

A street whose camera is at the origin. Each twentieth Gaussian is turned about the camera, with its
distance, shape and opacity, into one of two caps of 2°: above and below the camera, or to its left and
right (not behind it, where the panorama has its seam). Its size is that which it has in the street, where a
cap holds more of them than can be seen, or that of its new neighbours' gaps.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import report
from benchmarks.cases import Case, random_shot
from benchmarks.iteration import measure
from benchmarks.pairs import Counts, count
from benchmarks.street import street
from benchmarks.table import markdown
from panolog.orchestrator.resources.machine import cores
from panolog.scene.gaussians import Gaussians, concatenate

GOAL = 1.3  # times the horizon's time for a useful pair
CAP = math.radians(2)
EVERY = 20  # 5 %
HEAD = (
    *("Gaussians", "sizes", "where", "pairs/px", "evaluated/useful", "entries"),
    *("forward + backward ms", "ns per useful pair", "ratio"),
)


@dataclass(frozen=True)
class Row:
    """One model at one place."""

    what: str  # "all" or "5 % alone"
    sizes: str
    place: str
    counts: Counts
    milliseconds: float  # forward and backward
    pixels: int

    @property
    def nanoseconds(self) -> float:
        """For a useful pair."""
        return self.milliseconds * 1e6 / self.counts.useful

    def cells(self) -> tuple[object, ...]:
        """In the order of HEAD, without the ratio."""
        counts = self.counts
        rates = (counts.useful / self.pixels, counts.evaluated / counts.useful, round(counts.entries))
        return (self.what, self.sizes, self.place, *rates, self.milliseconds, self.nanoseconds)


def turned(gaussians: Gaussians, rotations: Rotation) -> Gaussians:
    """Each of N Gaussians, or all of them, turned about the origin."""
    means = rotations.apply(gaussians.means.numpy())
    shapes = rotations * Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]])  # scipy's are x y z w
    quats = shapes.as_quat()[:, [3, 0, 1, 2]]
    return replace(gaussians, means=_tensor(means), quats=_tensor(quats))


def to_poles(gaussians: Gaussians, seed: int = 0) -> Gaussians:
    """Each turned to a random direction within CAP of the zenith (even rows) or the nadir."""
    random = np.random.default_rng(seed)
    count = len(gaussians)
    polar = np.arccos(1 - random.uniform(0, 1, count) * (1 - math.cos(CAP)))  # even over the cap
    azimuth = random.uniform(0, 2 * math.pi, count)
    up = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    aims = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), up * np.cos(polar)], 1)
    directions = gaussians.means.numpy().astype(float)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = np.cross(directions, aims)
    sines = np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.arctan2(sines, (directions * aims).sum(1, keepdims=True))
    return turned(gaussians, Rotation.from_rotvec(axes * angles / np.maximum(sines, 1e-12)))


def places(count: int) -> Iterator[tuple[str, str, str, Gaussians]]:
    """(what, sizes, place, model) of all that is compared, the horizon before the poles."""
    everything = street(count)
    chosen = torch.arange(len(everything)) % EVERY == 0
    rest = replace(everything.select(~chosen), sky=0)
    moved = to_poles(replace(everything.select(chosen), sky=0))
    share_of_sphere = 1 - math.cos(CAP)  # two caps of 2π (1 - cos)
    closer = math.log(math.sqrt(share_of_sphere * EVERY))  # of the gaps, there and in the street
    for sizes, change in {"of the street": 0.0, "of the gaps": closer}.items():
        poles = replace(moved, scales=moved.scales + change)
        horizon = turned(poles, Rotation.from_euler("y", 90, degrees=True))  # z is up: the zenith to x
        for place, some in {"horizon": horizon, "poles": poles}.items():
            yield "all", sizes, place, concatenate(rest, some)
            yield "5 % alone", sizes, place, some


def compare(count_: int, width: int, device: str, repeats: int) -> list[Row]:
    """Measures all of them, horizon and poles next to each other."""
    rows = []
    shot = random_shot(width)
    for what, sizes, place, gaussians in places(count_):
        case = Case(place, gaussians, 0.0, (shot,))
        counts = count(case)
        times = measure(case.to(device), cores(), repeats)
        rows.append(Row(what, sizes, place, counts, times.rasterization, shot.pixels))
    return sorted(rows, key=lambda row: (row.what != "all", row.sizes))


def ratios(rows: Sequence[Row]) -> dict[tuple[str, str], float]:
    """Poles against horizon in time for a useful pair, by what and sizes."""
    times = {(row.what, row.sizes, row.place): row.nanoseconds for row in rows}
    pairs = dict.fromkeys((row.what, row.sizes) for row in rows)
    return {pair: times[(*pair, "poles")] / times[(*pair, "horizon")] for pair in pairs}


def tables(rows: Sequence[Row]) -> str:
    """The rows and the verdict, in Markdown."""
    found = ratios(rows)
    cells = [(*row.cells(), found[row.what, row.sizes] if row.place == "poles" else None) for row in rows]
    worst = max(ratio for (what, _), ratio in found.items() if what == "all")
    return f"{markdown(HEAD, cells)}\n\nWhole models: at most {worst:.2f} (goal: {GOAL})."


def content(rows: Sequence[Row]) -> dict[str, Any]:
    """All of it for JSON."""
    found = [{"what": what, "sizes": sizes, "ratio": ratio} for (what, sizes), ratio in ratios(rows).items()]
    return {"rows": [asdict(row) for row in rows], "ratios": found}


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.poles", description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--gaussians", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=7)
    report.add_options(parser)
    options = parser.parse_args()
    if options.quick:
        options.width, options.gaussians, options.repeats = 128, 1_000, 1

    def work() -> tuple[report.Content, str]:
        rows = compare(options.gaussians, options.width, options.device, options.repeats)
        return content(rows), tables(rows)

    return report.run("poles", options, work)


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


if __name__ == "__main__":
    sys.exit(main())
