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
    project,
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


def _nearest_first(gaussians: Gaussians, camera: Camera, degree: int, near: float, screen: Tensor) -> Tensor:
    """Rows that are drawn, nearest first; `project` decides on distance, opacity and what is finite."""
    with torch.no_grad():
        found = project(gaussians, camera, degree, near, screen)
    rows = found.drawable.nonzero()[:, 0]
    return rows[found.distance[rows].argsort(stable=True)]


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
    rows = _nearest_first(gaussians, camera, sh_degree, near, screen)
    drawn = gaussians.with_tensors({name: tensor[rows] for name, tensor in gaussians.tensors().items()}, 0)
    moving = None if motion is None else motion[rows]
    projected = project(drawn, camera, sh_degree, near, screen[rows], moving)
    exponential, along = pixel_alphas(drawn, camera, screen[rows], moving)
    alpha = torch.where((exponential >= ALPHA_MIN) & (along > 0), exponential.clamp(max=ALPHA_MAX), 0)
    left = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), 0)[:-1]
    weight = torch.where(left >= TRANSMITTANCE_MIN, alpha * left, 0)
    visible = torch.zeros(len(gaussians), dtype=torch.bool)
    visible[rows] = (alpha > 0).flatten(1).any(1)
    return Render(
        color=torch.einsum("nhw,nc->hwc", weight, projected.color),
        alpha=weight.sum(0),
        inverse_depth=torch.einsum("nhw,n->hw", weight, 1 / projected.distance),
        visible=visible,
        invalid=project(gaussians, camera, sh_degree, near, screen).invalid,
    )


def decided_rays(gaussians: Gaussians, camera: Camera, near: float) -> Tensor:
    """(H, W) bool: pixels where no pair is within 0.1% of a cut; on the others rounding decides."""
    screen = torch.zeros(len(gaussians), 2, dtype=torch.float64)
    rows = _nearest_first(gaussians, camera, 3, near, screen)
    drawn = gaussians.with_tensors({name: tensor[rows] for name, tensor in gaussians.tensors().items()}, 0)
    exponential, along = pixel_alphas(drawn, camera, screen[rows])
    close = (exponential - ALPHA_MIN).abs() < ALPHA_MIN * 1e-3
    size = along.abs().amax((1, 2), keepdim=True)
    close |= (exponential > ALPHA_MIN / 2) & (along.abs() < 1e-4 * size)
    alpha = torch.where((exponential >= ALPHA_MIN) & (along > 0), exponential.clamp(max=ALPHA_MAX), 0)
    left = torch.cumprod(1 - alpha, 0)
    return ~(close | ((left - TRANSMITTANCE_MIN).abs() < TRANSMITTANCE_MIN * 1e-3)).any(0)
