"""Scenes that break rasterizers, and the pixels on which no two correct ones need to agree."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.scene.gaussians import Gaussians
from tests.renderer import reference


def camera(width: int = 64, seed: int = 0) -> Camera:
    """A randomly turned camera near the origin."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    return Camera.of(rotation, rng.normal(size=3) * 0.1, width, width // 2)


def wide(at: Camera) -> Camera:
    """The same in float64."""
    return Camera(at.rotation.double(), at.translation.double(), at.width, at.height)


def cloud(count: int, seed: int = 0) -> Gaussians:
    """Anisotropic Gaussians all around."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    return Gaussians(
        means=normal(count, 3) * 3,
        quats=normal(count, 4),
        scales=normal(count, 3) * 0.7 - 1.5,
        opacities=normal(count) * 2,
        sh0=normal(count, 1, 3) * 0.5,
        shN=normal(count, 15, 3) * 0.15,
    )


def placed(count: int, in_camera: Tensor, at: Camera, log_scale: float, seed: int = 0) -> Gaussians:
    """A cloud moved so that its centres are `in_camera` (count, 3) in the camera's own frame."""
    some = cloud(count, seed)
    means = (in_camera - at.translation) @ at.rotation
    return Gaussians(means, some.quats, some.scales * 0.3 + log_scale, some.opacities, some.sh0, some.shN)


def directions(azimuth: Tensor, elevation: Tensor, nearest: float = 2.0) -> Tensor:
    """(N,), (N,) radians to (N, 3) points: azimuth from forward to the right, elevation downwards.

    Each is a little farther than the one before, so that their order is certain.
    """
    distance = nearest * torch.linspace(1, 1.5, len(azimuth))[:, None]
    flat = torch.cos(elevation)
    return distance * torch.stack(
        [torch.sin(azimuth) * flat, torch.sin(elevation), torch.cos(azimuth) * flat], -1
    )


def hard_scenes(at: Camera) -> dict[str, Gaussians]:
    """By name: on the seam, at both poles, behind, near, tiny, huge, transparent, crowded."""
    rng = torch.Generator().manual_seed(7)
    spread = torch.rand(40, generator=rng)
    sign = torch.where(torch.arange(40) % 2 == 0, 1.0, -1.0)
    scenes = {
        "cloud": cloud(150),
        "crowded": placed(
            150, directions(spread.repeat(4)[:150] * 0.4, spread.repeat(4)[:150] * 0.3), at, -1.0
        ),
        "seam": placed(40, directions(math.pi + (spread - 0.5) * 0.1, (spread - 0.5) * 2), at, -2.0),
        "poles": placed(40, directions(spread * 6.28, sign * (math.pi / 2 - spread * 0.05)), at, -2.5),
        "behind": placed(40, directions(math.pi - spread * 0.5, spread - 0.5), at, -1.5),
        "nearer than their size": placed(20, directions(spread[:20] * 6, spread[:20] - 0.5, 0.3), at, -0.5),
        "tiny": placed(40, directions(spread * 6, spread - 0.5), at, -9.0),
        "huge": placed(20, directions(spread[:20] * 6, spread[:20] - 0.5, 20.0), at, 3.0),
    }
    faint = cloud(80, 3)
    scenes["transparent"] = faint.with_tensors(faint.tensors() | {"opacities": faint.opacities * 0.5 - 5.2})
    return scenes


def needles(at: Camera) -> Gaussians:
    """Long and thin, in all directions, also along the ray; and flat ones."""
    spread = torch.rand(60, generator=torch.Generator().manual_seed(2))
    some = placed(60, directions(spread * 6.28, (spread.flip(0) - 0.5) * 3), at, -2.0)
    scales = some.scales.clone()
    scales[:30, 0] += 2.5
    scales[:30, 1:] -= 2
    scales[30:, 0] -= 4
    return some.with_tensors(some.tensors() | {"scales": scales})


def scenes(at: Camera, exact: bool) -> dict[str, Gaussians]:
    """By name, of one projection; needles and flat Gaussians are harder with the exact one."""
    some = hard_scenes(at) | ({"needles": needles(at)} if exact else {})
    return {name: replace(scene, exact=exact) for name, scene in some.items()}


def as_leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    """The same Gaussians as leaves that collect gradients."""
    tensors = gaussians.tensors().items()
    return gaussians.with_tensors({name: it.detach().to(dtype).requires_grad_() for name, it in tensors}, 0)


def decided(gaussians: Gaussians, at: Camera, near: float) -> Tensor:
    """(H, W) bool: pixels where no pair is within 0.1% of a cut (alpha 1/255, transmittance 1e-4).

    On the others rounding alone decides whether a pair counts, in float64 as in float32. All tensors float64.
    """
    screen = torch.zeros(len(gaussians), 2, dtype=torch.float64)
    projected = reference.project(gaussians, at, 3, near, screen)
    rows = reference.nearest_first(projected)
    sorted_rows = reference.Projected(*(field[rows] for field in projected))
    floor, limit = reference.ALPHA_MIN, reference.TRANSMITTANCE_MIN
    alpha = reference.pixel_alphas(sorted_rows, at, floor=floor * 0.999)
    close = ((alpha - floor).abs() < floor * 1e-3).any(0)
    left = torch.cumprod(1 - torch.where(alpha >= floor, alpha, 0), 0)
    return ~(close | ((left - limit).abs() < limit * 1e-3).any(0))


def wall(at: Camera, distance: float, size: float, opacity: float) -> Gaussians:
    """72 in a circle around the camera."""
    made = placed(
        72, directions(torch.linspace(-3.1, 3.1, 24).repeat(3), torch.zeros(72), distance), at, size
    )
    return made.with_tensors(made.tensors() | {"opacities": torch.full((72,), opacity)})
