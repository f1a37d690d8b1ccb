"""How fast a training iteration is, and what it is made of.

    python -m benchmarks.rasterizer [--width 1024] [--gaussians 50000,200000] [--threads 1,2] [--json]
    python -m benchmarks.rasterizer --model RUN/point_cloud.ply --scene SCENE

Each number is the median of several repetitions after a warm-up.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from statistics import fmean, median

import torch
from torch import Tensor

from benchmarks.pairs import useful_pairs
from benchmarks.street import middle, street
from benchmarks.table import markdown
from panolog.orchestrator.machine import cores
from panolog.renderer import _core
from panolog.renderer.camera import Camera
from panolog.renderer.losses import photometric_loss
from panolog.renderer.render import Render, render
from panolog.scene.errors import InputError, PanologError
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import load_view
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from panolog.workers.config import TrainConfig
from panolog.workers.initialise import near_distance
from panolog.workers.optimizer import Trainee, finite

SH_DEGREE = 3
HEAD = (
    *(
        "model",
        "size",
        "Gaussians",
        "threads",
        "forward ms",
        "loss ms",
        "backward ms",
        "Adam ms",
        "iteration ms",
    ),
    *("Mpx/s", "pairs/px"),
    *("forward Mpairs/s", "backward Mpairs/s", "iteration Mpairs/s"),
)


@dataclass(frozen=True, eq=False)
class Shot:
    """One image to train on."""

    camera: Camera
    target: Tensor  # (H, W, 3) uint8


@dataclass(frozen=True, eq=False)
class Case:
    """What is timed: a model and some images of it."""

    name: str
    gaussians: Gaussians
    near: float  # world units
    shots: tuple[Shot, ...]


@dataclass(frozen=True)
class Times:
    """Milliseconds of the parts of an iteration, and of a whole one measured by itself."""

    forward: float
    loss: float
    backward: float
    adam: float
    iteration: float


@dataclass(frozen=True)
class Row:
    """A case at a number of threads; means over its images."""

    model: str
    width: int  # pixels
    height: int
    gaussians: int
    threads: int
    pairs: float  # pixel-Gaussian pairs of an image with alpha ≥ 1/255 before the pixel is opaque
    times: Times

    def rates(self) -> dict[str, float]:
        """Pixels per second of whole iterations, and useful pairs per second of each direction and of all."""
        times, pixels = self.times, self.width * self.height
        parts = {"forward": times.forward, "backward": times.backward, "iteration": times.iteration}
        pairs = {f"{name}_pairs": self.pairs * 1e3 / ms for name, ms in parts.items()}
        return {"pixels": pixels * 1e3 / times.iteration, **pairs}

    def cells(self) -> tuple[object, ...]:
        """The row, in the order of HEAD."""
        head = (self.model, f"{self.width}×{self.height}", self.gaussians, self.threads)
        pixels, *pairs = (rate / 1e6 for rate in self.rates().values())
        return (*head, *astuple(self.times), pixels, self.pairs / (self.width * self.height), *pairs)


class Trainer:
    """The steps of a training iteration on one shot, as `workers.train` takes them.

    The learning rates are zero, so that every repetition meets the same Gaussians.
    """

    def __init__(self, case: Case, shot: Shot) -> None:
        self.case = case
        self.shot = shot
        self.trainee = Trainee.fresh(case.gaussians)
        self.rates = dict.fromkeys(case.gaussians.tensors(), 0.0)
        self.rows = dict.fromkeys(case.gaussians.tensors(), len(case.gaussians))

    def forward(self) -> tuple[Gaussians, Render]:
        """The leaves and their image."""
        leaves = self.trainee.leaves(SH_DEGREE)
        screen = torch.zeros(len(leaves), 2, requires_grad=True)
        return leaves, render(
            leaves, self.shot.camera, sh_degree=SH_DEGREE, near=self.case.near, screen=screen
        )

    def loss(self, color: Tensor) -> Tensor:
        """Eq. 6 without depth; color (H, W, 3)."""
        weight = TrainConfig().loss.lambda_ssim
        return photometric_loss(color, self.shot.target, None, weight).loss

    def adam(self, leaves: Gaussians, loss: Tensor) -> None:
        """The check that all is finite, and the step."""
        gradients = {name: leaf.grad for name, leaf in leaves.tensors().items() if leaf.grad is not None}
        finite(loss, gradients)
        self.trainee.step(gradients, self.rates, self.rows, step=1)

    def iteration(self) -> None:
        """All of it."""
        leaves, rendered = self.forward()
        loss = self.loss(rendered.color)
        loss.backward()  # type: ignore[no-untyped-call]
        self.adam(leaves, loss)

    def parts(self) -> Iterator[float]:
        """Seconds of forward, loss with its gradient, backward and Adam of one iteration."""
        start = time.perf_counter()
        leaves, rendered = self.forward()
        yield time.perf_counter() - start
        start = time.perf_counter()
        color = rendered.color.detach().requires_grad_()
        loss = self.loss(color)
        loss.backward()  # type: ignore[no-untyped-call]
        yield time.perf_counter() - start
        start = time.perf_counter()
        rendered.color.backward(color.grad)  # type: ignore[no-untyped-call]
        yield time.perf_counter() - start
        start = time.perf_counter()
        self.adam(leaves, loss)
        yield time.perf_counter() - start


def measure(case: Case, threads: int, repeats: int) -> Times:
    """Medians over `repeats`, means over the shots."""
    torch.set_num_threads(threads)
    shots = []
    for shot in case.shots:
        trainer = Trainer(case, shot)
        trainer.iteration()  # warm: pages, caches, first calls
        parts = zip(*(tuple(trainer.parts()) for _ in range(repeats)), strict=True)
        whole = [_seconds(trainer.iteration) for _ in range(repeats)]
        shots.append([median(part) * 1e3 for part in (*parts, whole)])
    return Times(*(fmean(part) for part in zip(*shots, strict=True)))


def _seconds(work: Callable[[], None]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def random_case(count: int, width: int) -> Case:
    """A street of random Gaussians."""
    generator = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (width // 2, width, 3), generator=generator, dtype=torch.uint8)
    return Case("street", street(count), 0.0, (Shot(middle(width), target),))


def trained_case(model: Path, scene_path: Path, width: int, views: int) -> Case:
    """A trained model with some of its training panoramas. Raises InputError if either cannot be read."""
    scene = read_scene(scene_path)
    if width > scene.width:
        raise InputError(f"--width {width}: the panoramas of {scene_path} have {scene.width} pixels")
    rows = scene.train[:: max(1, len(scene.train) // views)][:views]
    shots = []
    for row in rows:
        panorama = scene.panoramas[row]
        camera = Camera.of(panorama.rotation, panorama.translation, width, width // 2)
        shots.append(Shot(camera, load_view(panorama, row, width).image))
    return Case(model.stem, read_ply(model), near_distance(scene, TrainConfig()), tuple(shots))


def benchmark(cases: Iterable[Case], threads: Sequence[int], repeats: int) -> Iterator[Row]:
    """One row for each case and number of threads."""
    for case in cases:
        torch.set_num_threads(max(threads))
        pairs = fmean(useful_pairs(case.gaussians, shot.camera, near=case.near) for shot in case.shots)
        for count in threads:
            camera, times = case.shots[0].camera, measure(case, count, repeats)
            yield Row(case.name, camera.width, camera.height, len(case.gaussians), count, pairs, times)


def machine() -> dict[str, str | int]:
    """What the numbers were measured on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else "unknown",
        "cores": cores(),
        "instruction_set": _core.instruction_set(),
        "torch": torch.__version__,
    }


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""

    def numbers(text: str) -> list[int]:
        return [int(part) for part in text.split(",")]

    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rasterizer", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--width", type=numbers, default=[1024], help="of the images; a comma between two")
    parser.add_argument("--gaussians", type=numbers, default=[50_000, 200_000], help="of the random streets")
    parser.add_argument("--threads", type=numbers, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--model", type=Path, metavar="PLY", help="time this model instead; needs --scene")
    parser.add_argument("--scene", type=Path, help="the scene that the model was trained on")
    parser.add_argument("--views", type=int, default=3, help="training panoramas to time a model on")
    parser.add_argument("--quick", action="store_true", help="small and once: to see that it works")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parsed = parser.parse_args(arguments)
    if (parsed.model is None) != (parsed.scene is None):
        parser.error("--model and --scene go together")
    if parsed.quick:
        parsed.width, parsed.gaussians, parsed.repeats, parsed.views = [256], [5_000], 1, 1
    return parsed


def cases_of(options: argparse.Namespace) -> Iterator[Case]:
    """What the options ask for."""
    for width in options.width:
        if options.model is not None:
            yield trained_case(options.model, options.scene, width, options.views)
        else:
            yield from (random_case(count, width) for count in options.gaussians)


def main() -> int:
    """The program; returns its exit code."""
    options = parse()
    try:
        rows = list(benchmark(cases_of(options), options.threads, options.repeats))
    except PanologError as error:
        print(f"rasterizer: {error}", file=sys.stderr)
        return 2
    if options.json:
        content = [asdict(row) | {"per_second": row.rates()} for row in rows]
        print(json.dumps({"machine": machine(), "rows": content}, indent=2))
    else:
        print(", ".join(f"{key} {value}" for key, value in machine().items()), end="\n\n")
        print(markdown(HEAD, [row.cells() for row in rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
