"""Host time of a training iteration on a GPU: what Python and torch do, without kernels and without a card.

    python -m benchmarks.rasterizer.launches

A trainer runs as on a GPU, on tensors of the CPU. Kernels are packed for the driver, which is replaced. With
1,000 Gaussians at 64×32 the arithmetic of torch on the CPU hardly counts.
"""

import sys
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from unittest import mock

import numpy as np
import torch
from cuda.bindings import driver

from benchmarks import report
from panolog.renderer import ops
from panolog.renderer.cuda import card
from panolog.renderer.cuda.parts import Argument
from panolog.scene.depth_alignment import Alignment
from panolog.scene.images import PanoramaCache, View
from panolog.scene.model import Panorama, Scene
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE
from panolog.workers.training.config import SkyConfig, TrainConfig
from panolog.workers.training.trainer import Trainer, TrainSpec

GOAL_MS = 0.6
GAUSSIANS, WIDTH = 1_000, 64
_WARM_UP, _BATCH = 50, 50  # iterations


class Packing:
    """A `Launch` that does what `card.Card.launch` does, on a driver that launches nothing."""

    def __init__(self) -> None:
        self.prepared: dict[str, card.Prepared] = {}
        self.count = Counter[str]()

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        """As `parts.Launch`. No Gaussian meets a tile, and nothing is wrong."""
        self.count[kernel] += 1
        if kernel not in self.prepared:
            self.prepared[kernel] = card.Prepared.of(kernel, 0, arguments)
        self.prepared[kernel].launch(card.DEFAULT_STREAM, grid, block, arguments)
        for name in ("tile_counts", "report"):
            if kernel in ("project_forward", "project_ray_forward", "iteration_guard") and name in arguments:
                tensor = arguments[name]
                assert isinstance(tensor, torch.Tensor)
                tensor.zero_()


def street(count: int, width: int) -> tuple[Scene, View]:
    """Random points with one panorama, which has a mask, a sky and a depth map."""
    random = np.random.default_rng(0)
    panoramas = tuple(
        Panorama(f"{i}.png", Path(f"{i}.png"), np.eye(3), np.array([i, 0.0, 0.0]), np.arange(count))
        for i in range(2)
    )
    scene = Scene(
        root=Path(),
        width=width,
        height=width // 2,
        panoramas=panoramas,
        points=random.normal(size=(count, 3)) * 5,
        colors=random.integers(0, 256, (count, 3), np.uint8),
        train=(0, 1),
        test=(),
        fingerprint="street",
    )
    mask, depth = torch.ones(width // 2, width, dtype=torch.bool), torch.rand(width // 2, width)
    return scene, View(0, torch.zeros(width // 2, width, 3, dtype=torch.uint8), mask, ~mask, depth)


def measure(iterations: int) -> tuple[float, float, Counter[str]]:
    """Median and fastest milliseconds of an iteration, over batches; and the launches of one, by kernel."""
    scene, view = street(GAUSSIANS, WIDTH)
    config = TrainConfig(sky=SkyConfig(count=0))
    spec = TrainSpec(
        task=COARSE, scene=Value(scene), views=(0, 1), width=WIDTH, iterations=30_000, config=config, seed=0
    )
    packing = Packing()
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(ops, "launcher", return_value=packing))
        succeeds = (driver.CUresult.CUDA_SUCCESS,)
        stack.enter_context(mock.patch.object(driver, "cuLaunchKernel", lambda *_: succeeds))
        trainer = Trainer(spec, scene, stack.enter_context(PanoramaCache(scene, (0, 1), WIDTH, 2**20)))
        trainer.loss.depth._aligned[view.row] = Alignment(1.0, 0.1, None)
        list(trainer.begin())
        first = 10_000  # all degrees are in use, and screen gradients count
        took = []
        for begin in range(first, first + _WARM_UP + iterations, _BATCH):
            packing.count.clear()
            started = time.perf_counter()
            for iteration in range(begin, begin + _BATCH):
                trainer.step(iteration, view)
            took.append((time.perf_counter() - started) / _BATCH * 1e3)
        counted = Counter({kernel: number // _BATCH for kernel, number in packing.count.items()})
        trainer.settle()
    batches = took[_WARM_UP // _BATCH :]
    return median(batches), min(batches), counted


def main(arguments: list[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("rasterizer.launches", __doc__)
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        torch.set_num_threads(1)
        middle, fastest, launched = measure(200 if options.quick else 2000)
        content = {"median_ms": middle, "fastest_ms": fastest, "launches": dict(launched)}
        rows = [
            ("host time of an iteration, median of batches", f"{middle:.3f} ms", f"≤ {GOAL_MS} ms"),
            ("the same, fastest batch", f"{fastest:.3f} ms", ""),
            ("launches of an iteration", str(launched.total()), ""),
        ]
        table = report.markdown(("what", "measured", "goal"), rows)
        return report.Report(content, table, passed=options.quick or middle <= GOAL_MS)

    return report.run("rasterizer.launches", options, work)


if __name__ == "__main__":
    sys.exit(main())
