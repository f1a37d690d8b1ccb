"""How many pairs of pixel and Gaussian an image is made of: slow, from the reference's formulas."""

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.cases import Case, Shot
from benchmarks.iteration import SH_DEGREE
from panolog.renderer import ops, reference
from panolog.renderer.camera import Camera
from panolog.renderer.reference import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Projected
from panolog.scene.gaussians import Gaussians

_CHUNK = 2**22  # pairs evaluated at a time


@dataclass(frozen=True)
class Counts:
    """What there is in an image; means over the shots of a case."""

    useful: float  # pairs with alpha ≥ 1/255 before their pixel is opaque: no rasterizer can do with fewer
    entries: float  # splats in tiles
    visible: float  # Gaussians with a footprint in the image


def count(case: Case) -> Counts:
    """The counts of a case, on the CPU whatever the device of its timing."""
    on_host = case.to("cpu")
    shots = [_count(on_host, shot) for shot in on_host.shots]
    return Counts(*(fmean(part) for part in zip(*shots, strict=True)))


@torch.no_grad()
def _count(case: Case, shot: Shot) -> tuple[float, int, int]:
    tiles, state = _frame(case, shot)
    useful = useful_pairs(case.gaussians, shot.camera, near=case.near)
    return useful, int(tiles[-1]), int((state == ops.VISIBLE).sum())


def _frame(case: Case, shot: Shot) -> tuple[Tensor, Tensor]:
    """What the forward pass leaves: where the entries of tiles begin (T + 1,), and states (N,)."""
    camera = shot.camera
    screen = case.gaussians.means.new_zeros(len(case.gaussians), 2)
    pose = (camera.rotation, camera.translation, camera.width, camera.height)
    result = ops.rasterize(*case.gaussians.tensors().values(), screen, *pose, SH_DEGREE, case.near)
    _, _, _, state, _, _, _, tiles = result
    return tiles, state


@torch.no_grad()
def useful_pairs(gaussians: Gaussians, camera: Camera, *, near: float = 0.0, rows: int = 64) -> float:
    """Pairs with alpha ≥ 1/255 before their pixel is opaque: no rasterizer can do with fewer.

    Args: rows, how many image rows are counted, evenly chosen; the count is scaled to all of them. With as
    many as the image has it is exact.
    """
    near_to_far = _project(gaussians, camera, near)
    rows = min(rows, camera.height)
    chosen = [(2 * i + 1) * camera.height // (2 * rows) for i in range(rows)]
    return sum(_row_pairs(near_to_far, camera.width, row) for row in chosen) * camera.height / rows


def _project(gaussians: Gaussians, camera: Camera, near: float) -> Projected:
    """Those that can be drawn, near to far."""
    projected = reference.project(gaussians, camera, 0, near, torch.zeros(len(gaussians), 2))
    rows = projected.drawable.nonzero()[:, 0]
    rows = rows[projected.distance[rows].argsort(stable=True)]
    return Projected(*(field[rows] for field in projected))


def _row_pairs(projected: Projected, width: int, row: int) -> int:
    """The pairs of one image row."""
    clear = torch.ones(width)  # transmittance of each pixel
    count = 0
    for alpha in _row_alphas(projected, width, row):
        left = clear * torch.cumprod(torch.cat([torch.ones(1, width), 1 - alpha]), 0)
        count += int(((alpha > 0) & (left[:-1] >= TRANSMITTANCE_MIN)).sum())
        clear = left[-1]
    return count


def _row_alphas(projected: Projected, width: int, row: int) -> Iterator[Tensor]:
    """(M, W) alphas of a row, 0 below the floor, of those that reach it; near to far, some at a time."""
    dv = row + 0.5 - projected.uv[:, 1]
    cut = 2 * torch.log(projected.opacity / ALPHA_MIN)  # of the quadratic form, where alpha is 1/255
    reaching = (dv**2 <= 1.001 * cut * projected.covariance[:, 1, 1] + 1e-3).nonzero()[:, 0]
    u = torch.arange(width) + 0.5
    for some in torch.split(reaching, max(1, _CHUNK // width)):
        conic = torch.linalg.inv(projected.covariance[some])
        du = u - projected.uv[some, :1]
        du = du - width * torch.floor(du / width + 0.5)
        dy = dv[some, None]
        form = conic[:, :1, 0] * du**2 + 2 * conic[:, :1, 1] * du * dy + conic[:, 1:, 1] * dy**2
        alpha = (projected.opacity[some, None] * torch.exp(-0.5 * form)).clamp(max=ALPHA_MAX)
        yield torch.where(alpha >= ALPHA_MIN, alpha, 0)
