"""Full training iterations beside those of OpenSplat, the one public trainer that runs on CPUs.

    python -m benchmarks.opensplat --scene FLAT [--model 50K.ply] [--json]

Its figures are those of OpenSplat 1.2.0, measured for this project on cores like those of a present server:
full training iterations (projection, forward, loss, backward, Adam) on 256×256 faces of 90° of the scene
`flat`, with one core pinned, or two. Panoramas of 1024×512 have as many pixels for each degree. The counts
of Gaussians are the same: those of the sparse points, untrained, and 50,000, trained.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import torch

from benchmarks import report
from benchmarks.cases import Case, scene_case
from benchmarks.iteration import measure
from benchmarks.pairs import Counts, count
from benchmarks.table import markdown
from panolog.renderer import reference
from panolog.renderer.camera import Camera
from panolog.scene.errors import InputError, RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply, write_ply
from panolog.scene.read import read_scene
from panolog.workers.events import Trained
from panolog.workers.training.config import (
    CheckpointConfig,
    DensifyConfig,
    PreviewConfig,
    SkyConfig,
    TrainConfig,
)
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.trainer import TrainTask, train

WIDTH = 1024
MANY = 50_000  # Gaussians of the trained model
ITERATIONS = 600  # in which it is trained: the cap is reached after half of them
GOALS = {1: 15, 2: 20}  # times OpenSplat's pixels per second, by threads
HEAD = (
    *("model", "Gaussians", "on", "iteration ms", "Mpx/s", "OpenSplat Mpx/s", "ratio", "goal"),
    *("useful pairs/px", "in its boxes", "OpenSplat's pairs/px", "ratio in pairs"),
)


@dataclass(frozen=True)
class Published:
    """OpenSplat 1.2.0 at one count of Gaussians."""

    pairs_per_pixel: float
    pixels: Mapping[int, float]  # pixels per second by threads, of full training iterations


PUBLISHED = {
    3_850: Published(35, {1: 0.22e6, 2: 0.28e6}),
    50_000: Published(134, {1: 0.064e6}),
}


@dataclass(frozen=True)
class Row:
    """Ours at one count and number of threads."""

    model: str
    gaussians: int
    threads: int
    pixels: int  # of an image
    counts: Counts
    boxes: float  # pairs that OpenSplat would look at in an image
    milliseconds: float  # an iteration

    @property
    def on(self) -> str:
        """Where it ran."""
        return "1 thread" if self.threads == 1 else f"{self.threads} threads"

    @property
    def rate(self) -> float:
        """Pixels per second of full iterations."""
        return self.pixels * 1e3 / self.milliseconds

    @property
    def ratio(self) -> float | None:
        """To OpenSplat's pixels per second; None where it has no figure."""
        theirs = self._published().pixels.get(self.threads)
        return None if theirs is None else self.rate / theirs

    @property
    def ratio_of_pairs(self) -> float | None:
        """The same in pairs per second, ours counted in its boxes: our models may be lighter than its."""
        if self.ratio is None:
            return None
        return self.ratio * self.boxes / self.pixels / self._published().pairs_per_pixel

    def cells(self) -> tuple[object, ...]:
        """In the order of HEAD."""
        theirs = self._published()
        pixels = theirs.pixels.get(self.threads)
        speed = (self.rate / 1e6, pixels and pixels / 1e6, self.ratio, pixels and GOALS.get(self.threads))
        ours = (self.counts.useful / self.pixels, self.boxes / self.pixels)
        head = (self.model, self.gaussians, self.on, self.milliseconds)
        return (*head, *speed, *ours, theirs.pairs_per_pixel, self.ratio_of_pairs)

    def _published(self) -> Published:
        """Of the count nearest to ours."""
        return PUBLISHED[min(PUBLISHED, key=lambda other: abs(other - self.gaussians))]


def train_model(scene: Scene) -> Gaussians:
    """Exactly MANY Gaussians, trained from the sparse points without a sky. Raises RunError if not."""
    never = 10 * ITERATIONS
    config = TrainConfig(
        sky=SkyConfig(count=0),
        densify=DensifyConfig(max_gaussians=MANY),
        preview=PreviewConfig(every=never),
        checkpoint=CheckpointConfig(every=never),
    )
    task = TrainTask("coarse", scene, scene.train, WIDTH, ITERATIONS, config, seed=0)
    (model,) = (event.gaussians for event in train(task) if isinstance(event, Trained))
    if len(model) != MANY:
        raise RunError(f"{scene.root}: training ended with {len(model)} Gaussians, not {MANY}")
    return model


def kept_model(path: Path, scene: Scene) -> Gaussians:
    """The PLY, or what is trained now and written to it."""
    if not path.exists():
        model = train_model(scene)
        write_ply(path, [model], count=len(model), sky=0)
    return read_ply(path)


def cases(scene: Scene, model: Path, views: int) -> Iterator[Case]:
    """The sparse points and the model of MANY Gaussians."""
    yield scene_case("sparse points", scene_gaussians(scene), scene, WIDTH, views)
    yield scene_case(f"trained, {ITERATIONS} iterations", kept_model(model, scene), scene, WIDTH, views)


@torch.no_grad()
def boxes(case: Case) -> float:
    """Pairs within the boxes in which OpenSplat looks at every pixel, mean over the shots.

    They reach three standard deviations along each axis, rounded up, and two pixels more
    (rasterize_forward_tensor_cpu in its gsplat_cpu.cpp).
    """
    return fmean(_boxes(case, shot.camera) for shot in case.shots)


def _boxes(case: Case, camera: Camera) -> float:
    screen = case.gaussians.means.new_zeros(len(case.gaussians), 2)
    projected = reference.project(case.gaussians, camera, 0, case.near, screen)
    uv = projected.uv[projected.drawable]
    reach = 3 * projected.covariance[projected.drawable].diagonal(dim1=1, dim2=2).sqrt()
    first, last = (uv - reach).floor() - 2, (uv + reach).ceil() + 2
    across = (last - first)[:, 0].clamp(max=camera.width)  # the panorama has no left and right end
    down = last[:, 1].clamp(max=camera.height) - first[:, 1].clamp(min=0)
    return float((across * down.clamp(min=0)).double().sum())


def compare(compared: Iterator[Case], threads: Sequence[int], repeats: int) -> list[Row]:
    """Measures them."""
    rows = []
    for case in compared:
        counts, looked_at, pixels = count(case), boxes(case), case.shots[0].pixels
        for many in threads:
            milliseconds = measure(case, many, repeats).iteration
            rows.append(Row(case.name, len(case.gaussians), many, pixels, counts, looked_at, milliseconds))
    return rows


def content(rows: Sequence[Row]) -> report.Content:
    """For JSON."""
    return {"rows": [asdict(row) | {"pixels_per_second": row.rate, "ratio": row.ratio} for row in rows]}


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.opensplat", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--scene", type=Path, required=True, help="the scene flat, in COLMAP's layout")
    parser.add_argument("--model", type=Path, help=f"PLY of {MANY:,} Gaussians; trained if it is not there")
    parser.add_argument("--threads", type=report.numbers, default=[1, 2])
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=5)
    report.add_options(parser)
    options = parser.parse_args()

    def work() -> tuple[report.Content, str]:
        if options.device != "cpu":
            raise InputError(f"--device {options.device}: OpenSplat's figures are those of a CPU")
        with tempfile.TemporaryDirectory() as folder:
            model = options.model or Path(folder, "many.ply")
            compared = cases(read_scene(options.scene), model, options.views)
            rows = compare(compared, options.threads, 1 if options.quick else options.repeats)
        return content(rows), markdown(HEAD, [row.cells() for row in rows])

    return report.run("opensplat", options, work)


if __name__ == "__main__":
    sys.exit(main())
