"""The rasterizer a second time, in plain PyTorch: the definition that the kernels are tested against.

Dense over pixels and Gaussians, in the precision of its input, differentiated by autograd. For small scenes.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.render import Render
from panolog.scene.gaussians import Gaussians

ALPHA_MIN = 1 / 255  # a pair below this does not count
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4  # a pixel below this is opaque: whatever follows does not count
LOW_PASS = 0.3  # px² added to the diagonal of the 2D covariance
LEAST_NORM = 1e-18  # of a quaternion
POLE = 1e-4  # sine of the polar distance below which the azimuth counts as undefined


class Projected(NamedTuple):
    """N Gaussians on the panorama."""

    uv: Tensor  # (N, 2) pixels
    covariance: Tensor  # (N, 2, 2) px², low-pass included
    opacity: Tensor  # (N,)
    color: Tensor  # (N, 3)
    distance: Tensor  # (N,) radial, world units
    drawable: Tensor  # (N,) bool: beyond the near cut, opaque enough
    invalid: Tensor  # (N,) bool


def rotation_matrices(quats: Tensor) -> Tensor:
    """(N, 4) quaternions w x y z, normalised here, to (N, 3, 3) rotation matrices."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def sh_basis(directions: Tensor) -> Tensor:
    """(N, 3) unit directions to the (N, 16) real spherical harmonics of degrees 0 to 3, signs as in 3DGS."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        -1,
    )


def _azimuth(points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(N, 3) camera points to (N,): √(x² + z²), its (x, z) direction, and whether that counts as undefined.

    There, within `POLE` of the vertical, the root is held at its bound and none of them has a gradient.
    """
    x, _, z = points.unbind(-1)
    bound = POLE * points.norm(dim=-1)
    pole = x**2 + z**2 < bound**2
    root = torch.where(pole, bound.detach(), torch.where(pole, 1, x**2 + z**2).sqrt())
    rho = torch.hypot(x, z).detach()
    upright = rho == 0
    unit_x = torch.where(pole, torch.where(upright, 0, x.detach() / rho), x / root)
    unit_z = torch.where(pole, torch.where(upright, 1, z.detach() / rho), z / root)
    return root, unit_x, unit_z, pole


def jacobian(points: Tensor, width: int, height: int) -> Tensor:
    """(N, 3) camera points to the (N, 2, 3) ERP Jacobian of appendix B, pixels per world unit."""
    fx, fy = width / (2 * math.pi), height / math.pi
    y, square = points[:, 1], (points * points).sum(-1)
    root, ux, uz, pole = _azimuth(points)
    row_u = torch.stack([fx * uz / root, torch.zeros_like(y), -fx * ux / root], -1)
    row_v = torch.stack([-fy * ux * y / square, fy * root / square, -fy * uz * y / square], -1)
    both = torch.stack([row_u, row_v], -2)
    return torch.where(pole[:, None, None], both.detach(), both)


def _pixels(points: Tensor, width: int, height: int) -> Tensor:
    """(N, 3) camera points to (N, 2) pixels (appendix B). At the pole only the height moves the pixel."""
    x, y, z = points.unbind(-1)
    root, _, _, pole = _azimuth(points)
    azimuth = torch.atan2(torch.where(pole, x.detach(), x), torch.where(pole, z.detach(), z))
    elevation = torch.atan2(y, root)
    return torch.stack(
        [width / (2 * math.pi) * azimuth + width / 2, height / math.pi * elevation + height / 2], -1
    )


class Seen(NamedTuple):
    """N Gaussians in the coordinates of a camera that has moved, as each of them sees it move."""

    points: Tensor  # (N, 3)
    axes: Tensor  # (N, 3, 3) the rotations of the Gaussians
    direction: Tensor  # (N, 3) unit vectors of view in the world


def seen(gaussians: Gaussians, camera: Camera, motion: Tensor | None) -> Seen:
    """X_cam = exp(ω)·(R·X + t) + τ, for each Gaussian with its own row of `motion` (N, 6): τ, ω; None: 0."""
    points = gaussians.means @ camera.rotation.T + camera.translation
    turned = camera.rotation.expand(len(points), 3, 3)
    if motion is not None:
        x, y, z = motion[:, 3:].unbind(-1)
        zero = torch.zeros_like(x)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
        turn = torch.matrix_exp(skew)
        points = torch.einsum("nij,nj->ni", turn, points) + motion[:, :3]
        turned = turn @ turned
    direction = torch.einsum("nji,nj->ni", turned, points / points.norm(dim=-1, keepdim=True))
    return Seen(points, turned @ rotation_matrices(gaussians.quats), direction)


def project(
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int,
    near: float,
    screen: Tensor,
    motion: Tensor | None = None,
) -> Projected:
    """Eq. 2 and appendix B for N Gaussians; `screen` (N, 2) is added to the pixels; `motion` as in `seen`."""
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)[:, : (sh_degree + 1) ** 2]
    parameters = [
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities[:, None],
        coefficients,
    ]
    finite = torch.cat([tensor.flatten(1) for tensor in parameters], 1).isfinite().all(1)
    size = gaussians.scales.exp()
    points, rotations, direction = seen(gaussians, camera, motion)
    factor = jacobian(points, camera.width, camera.height) @ rotations * size[:, None, :]  # (N, 2, 3)
    covariance = factor @ factor.transpose(1, 2) + LOW_PASS * torch.eye(2, dtype=factor.dtype)
    distance = points.norm(dim=-1)
    opacity = gaussians.opacities.sigmoid()
    color = torch.einsum("nk,nkc->nc", sh_basis(direction)[:, : (sh_degree + 1) ** 2], coefficients) + 0.5
    valid = finite & (gaussians.quats.norm(dim=-1) > LEAST_NORM) & screen.isfinite().all(1)
    valid &= covariance.isfinite().flatten(1).all(1) & color.isfinite().all(1)
    return Projected(
        _pixels(points, camera.width, camera.height) + screen,
        covariance,
        opacity,
        color.clamp(min=0),
        distance,
        valid & (distance > near) & (opacity >= ALPHA_MIN),
        ~valid,
    )


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int = 3,
    near: float = 0.0,
    screen: Tensor | None = None,
    motion: Tensor | None = None,
) -> Render:
    """`renderer.render.render` by definition: O(N · H · W) time and memory, any float type."""
    if screen is None:
        screen = gaussians.means.new_zeros((len(gaussians), 2))
    all_projected = project(gaussians, camera, sh_degree, near, screen)
    rows = nearest_first(all_projected)
    # projected again without the others, so that no gradient meets a value that is not finite
    moving = None if motion is None else motion[rows]
    projected = project(rows_of(gaussians, rows), camera, sh_degree, near, screen[rows], moving)
    return blended(projected, pixel_alphas(projected, camera), rows, all_projected.invalid)


def rows_of(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    """Some rows (M,), in their order, none of them as sky."""
    return gaussians.with_tensors({name: tensor[rows] for name, tensor in gaussians.tensors().items()}, 0)


def nearest_first(projected: Projected) -> Tensor:
    """(M,) the rows that are drawn."""
    rows = projected.drawable.nonzero()[:, 0]
    return rows[projected.distance[rows].argsort(stable=True)]


def blended(projected: Projected, alpha: Tensor, rows: Tensor, invalid: Tensor) -> Render:
    """Eq. 1 for M Gaussians, nearest first, with alphas (M, H, W): the `rows` (M,) of `invalid` (N,)."""
    transmittance = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), 0)[:-1]
    weight = torch.where(transmittance >= TRANSMITTANCE_MIN, alpha * transmittance, 0)
    visible = torch.zeros(len(invalid), dtype=torch.bool)
    visible[rows] = (alpha > 0).flatten(1).any(1)
    return Render(
        torch.einsum("nhw,nc->hwc", weight, projected.color),
        weight.sum(0),
        torch.einsum("nhw,n->hw", weight, 1 / projected.distance),
        visible,
        invalid,
    )


def pixel_alphas(projected: Projected, camera: Camera, floor: float = ALPHA_MIN) -> Tensor:
    """(M, H, W) alpha of every pair, 0 below the floor. The panorama is a cylinder: u is periodic."""
    dtype = projected.uv.dtype
    u = torch.arange(camera.width, dtype=dtype) + 0.5
    v = torch.arange(camera.height, dtype=dtype) + 0.5
    du = u[None] - projected.uv[:, :1]
    du = du - camera.width * torch.floor(du.detach() / camera.width + 0.5)
    dv = v[None] - projected.uv[:, 1:]
    conic = torch.linalg.inv(projected.covariance)
    quadratic = (
        conic[:, 0, 0, None, None] * du[:, None, :] ** 2
        + 2 * conic[:, 0, 1, None, None] * du[:, None, :] * dv[:, :, None]
        + conic[:, 1, 1, None, None] * dv[:, :, None] ** 2
    )
    alpha = (projected.opacity[:, None, None] * torch.exp(-0.5 * quadratic)).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= floor, alpha, 0)
