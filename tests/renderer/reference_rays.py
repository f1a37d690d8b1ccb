"""Exact projection in plain PyTorch, from its definition alone: what csrc/rays.h is tested against.

Dense over pixels and Gaussians, in float64, differentiated by autograd. For small scenes.
"""

import math

import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.render import Render
from panolog.scene.gaussians import Gaussians
from tests.renderer.reference import (
    ALPHA_MAX,
    ALPHA_MIN,
    LOW_PASS,
    TRANSMITTANCE_MIN,
    blended,
    nearest_first,
    project,
    rows_of,
    seen,
)


def pixel_rays(camera: Camera) -> Tensor:
    """(H, W, 3) unit directions of the pixels in the camera's coordinates."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    azimuth = (u.double() + 0.5) / camera.width * 2 * math.pi - math.pi
    elevation = (v.double() + 0.5) / camera.height * math.pi - math.pi / 2
    level = elevation.cos()
    return torch.stack([level * azimuth.sin(), elevation.sin(), level * azimuth.cos()], -1)


def _turned(rays: Tensor, points: Tensor, camera: Camera, screen: Tensor) -> Tensor:
    """(N, H, W, 3) the rays in the frame of a Gaussian that turned by `screen` (N, 2) pixels."""
    toward = (points / points.norm(dim=1, keepdim=True)).detach()
    level = torch.hypot(toward[:, 0], toward[:, 2])
    east = torch.stack([toward[:, 2] / level, torch.zeros_like(level), -toward[:, 0] / level], 1)
    south = torch.linalg.cross(east, toward)
    south = south * torch.sign(south[:, 1:2])
    angle_u = screen[:, 0] * level * (2 * math.pi / camera.width)
    angle_v = screen[:, 1] * (math.pi / camera.height)
    step = angle_u[:, None] * east + angle_v[:, None] * south
    turn = step[:, :, None] * toward[:, None, :]
    return rays + torch.einsum("nij,hwi->nhwj", turn - turn.transpose(1, 2), rays)


def pixel_alphas(
    gaussians: Gaussians, camera: Camera, screen: Tensor, motion: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """(N, H, W) each: alpha without cuts, and the ray's part along which the Gaussian lies, negative behind.

    A ray r meets a Gaussian with the inverse covariance A and the mean m most closely, in its standard
    deviations, at the distance d with d² = mᵀAm - (mᵀAr)² / rᵀAr. The low-pass filter is an angle.
    """
    points, axes, _ = seen(gaussians, camera, motion)
    factor = axes * gaussians.scales.exp()[:, None, :]
    blur = LOW_PASS * (math.pi / camera.height) ** 2 * (points**2).sum(1)
    eye = torch.eye(3, dtype=points.dtype)
    inverse = torch.linalg.inv(factor @ factor.transpose(1, 2) + blur[:, None, None] * eye)
    rays = _turned(pixel_rays(camera), points, camera, screen)
    weighted = torch.einsum("nij,nj->ni", inverse, points)
    along = torch.einsum("ni,nhwi->nhw", weighted, rays)
    square = torch.einsum("nhwi,nij,nhwj->nhw", rays, inverse, rays)
    distance = (weighted * points).sum(1)[:, None, None] - along**2 / square
    return gaussians.opacities.sigmoid()[:, None, None] * torch.exp(-0.5 * distance), along


def render_rays(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int = 3,
    near: float = 0.0,
    screen: Tensor,
    motion: Tensor | None = None,
) -> Render:
    """`renderer.render.render` for Gaussians with `exact`; all tensors float64."""
    found = project(gaussians, camera, sh_degree, near, screen)  # what is finite, far and opaque enough
    rows = nearest_first(found)
    drawn, moving = rows_of(gaussians, rows), None if motion is None else motion[rows]
    projected = project(drawn, camera, sh_degree, near, screen[rows], moving)
    exponential, along = pixel_alphas(drawn, camera, screen[rows], moving)
    return blended(projected, _cut(exponential, along), rows, found.invalid)


def _cut(exponential: Tensor, along: Tensor) -> Tensor:
    """(N, H, W) the alphas that count."""
    return torch.where((exponential >= ALPHA_MIN) & (along > 0), exponential.clamp(max=ALPHA_MAX), 0)


def decided_rays(gaussians: Gaussians, camera: Camera, near: float) -> Tensor:
    """(H, W) bool: pixels where no pair is within 0.1% of a cut; on the others rounding decides."""
    screen = torch.zeros(len(gaussians), 2, dtype=torch.float64)
    rows = nearest_first(project(gaussians, camera, 3, near, screen))
    exponential, along = pixel_alphas(rows_of(gaussians, rows), camera, screen[rows])
    close = (exponential - ALPHA_MIN).abs() < ALPHA_MIN * 1e-3
    size = along.abs().amax((1, 2), keepdim=True)
    close |= (exponential > ALPHA_MIN / 2) & (along.abs() < 1e-4 * size)
    left = torch.cumprod(1 - _cut(exponential, along), 0)
    return ~(close | ((left - TRANSMITTANCE_MIN).abs() < TRANSMITTANCE_MIN * 1e-3)).any(0)
