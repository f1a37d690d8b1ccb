"""Pairs of pixel and Gaussian: how many an image is made of, and how many a processor can do per second."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.rasterizer.cases import Case, TrainingView
from benchmarks.rasterizer.iteration import SH_DEGREE
from panolog.renderer import _core, ops

SECONDS = 0.2  # of each loop of the ceiling


@dataclass(frozen=True)
class Counts:
    """Counts of an image; means over the views of a case."""

    useful: float  # pairs with alpha ≥ 1/255 before their pixel is opaque: no rasterizer can do with fewer
    evaluated: float  # pairs whose alpha the CPU kernels compute to find those
    entries: float  # splats in tiles
    visible: float  # Gaussians with a footprint in the image


def count(case: Case) -> Counts:
    """The counts of a case, on the CPU whatever the device of its timing."""
    on_host = case.to("cpu")
    counts = [_count(on_host, view) for view in on_host.views]
    return Counts(*(fmean(part) for part in zip(*counts, strict=True)))


@torch.no_grad()
def _count(case: Case, view: TrainingView) -> tuple[int, int, int, int]:
    splats, entries, tiles, state = _frame(case, view)
    camera = view.camera
    arrays = (splats.numpy(), entries.numpy(), tiles.numpy())
    evaluated, useful = _core.count_pairs(*arrays, camera.width, camera.height)
    return useful, evaluated, int(tiles[-1]), int((state == ops.VISIBLE).sum())


def _frame(case: Case, view: TrainingView) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Buffers of the forward pass: splats (16 N,), entries, tiles (T + 1,), and states (N,)."""
    camera = view.camera
    screen = case.gaussians.means.new_zeros(len(case.gaussians), 2)
    _, _, _, state, splats, _, entries, tiles = ops.rasterize(
        **case.gaussians.tensors(), screen=screen, **vars(camera), sh_degree=SH_DEGREE, near=case.near
    )
    return splats, entries, tiles, state


@dataclass(frozen=True)
class Ceiling:
    """Pairs per second of all threads together, limited by arithmetic only."""

    forward: float
    backward: float


def ceiling(threads: int) -> Ceiling:
    """Measured now, so that other load of the machine affects it as much as the row that it belongs to."""
    return Ceiling(_together(threads, backward=False), _together(threads, backward=True))


def _together(threads: int, *, backward: bool) -> float:
    """The sum over parallel loops, which do not hold the GIL."""
    with ThreadPoolExecutor(threads) as pool:
        loops = [pool.submit(_core.ceiling, backward, SECONDS) for _ in range(threads)]
        return sum(loop.result() for loop in loops)
