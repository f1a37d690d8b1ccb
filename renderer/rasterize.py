"""Rasterization of plain tensors: several cameras, colours of any number of channels, a background.

It is `renderer.render.render`, once for each camera and each three channels.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import SH_C0, SH_REST, Gaussians

_DEGREES = {(degree + 1) ** 2: degree for degree in range(4)}  # by the number of coefficients
_LEAST = 1e-6  # range of a channel that is 0 everywhere
_MARGIN = 0.5  # of the features' range: the kernels clamp at 0 what lies below it


class Raster(NamedTuple):
    """What C cameras see of N Gaussians. H rows from the zenith (top) to the nadir, W columns around."""

    color: Tensor  # (C, H, W, X) over the background
    alpha: Tensor  # (C, H, W) accumulated opacity, 1 - transmittance
    inverse_depth: Tensor  # (C, H, W) Σ (1/r) α T of radial distances r, not normalised; 1 / world units
    screen: Tensor  # (C, N, 2) zeros; after `backward` their `grad` is that of places, per pixel
    visible: Tensor  # (C, N) bool: its footprint overlaps the image, hidden by others or not
    cameras: tuple[Camera, ...]

    @property
    def depth(self) -> Tensor:
        """(C, H, W) radial distances, world units: harmonic means of what is seen, inf where nothing is."""
        seen = self.inverse_depth > 0
        return torch.where(seen, self.alpha / torch.where(seen, self.inverse_depth, 1), torch.inf)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    cameras: Sequence[Camera],
    *,
    colors: Tensor | None = None,
    sh: Tensor | None = None,
    background: Tensor | None = None,
    near: float = 0.0,
    exact: bool = False,
) -> Raster:
    """Rasterizes N Gaussians into an equirectangular panorama for each of C cameras (eqs. 1 and 2).

    Differentiable in all tensors: means, quats, scales, opacities, colors or sh, the background, and the
    cameras' poses. Cameras are rendered one after the other, and more than three channels in passes of three.

    Args:
        means: (N, 3) in world units. All of the Gaussians are float32 and on one device, "cpu" or "cuda".
        quats: (N, 4) rotations w x y z, of any length but zero.
        scales: (N, 3) logarithms of the standard deviations in world units.
        opacities: (N,) logits.
        cameras: C of one size. Where a pose requires grad it gets one, also on a GPU with poses on the CPU.
        colors: (N, X), RGB or features of any range and number; errors are about 1e-7 of a channel's range.
        sh: in place of `colors`, (N, K, 3) spherical harmonics of RGB, with K = 1, 4, 9 or 16.
        background: (X,) or (C, X), what is seen where nothing hides it; black if None.
        near: radial distance in world units below which a Gaussian is not drawn.
        exact: along the ray of each pixel, not as affine splats (eq. 2), which err at poles and where near.

    Returns:
        The images; `screen` and `visible` are what growth strategies use.

    Raises:
        ValueError: shapes or types do not fit, or there is no camera.

    >>> import torch, panolog
    >>> camera = panolog.Camera(torch.eye(3), torch.zeros(3), width=64, height=32)
    >>> means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)  # two units ahead
    >>> shape = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), -1.0), torch.tensor([4.0])
    >>> raster = panolog.rasterize(means, *shape, [camera], colors=torch.tensor([[1.0, 0.5, 0.0, 7.0]]))
    >>> raster.color.shape, round(raster.depth[0, 16, 32].item(), 1)
    (torch.Size([1, 32, 64, 4]), 2.0)
    >>> raster.color.sum().backward()
    >>> means.grad.shape, raster.screen.grad.shape
    (torch.Size([1, 3]), torch.Size([1, 1, 2]))
    """
    if len({(camera.width, camera.height) for camera in cameras}) != 1:
        raise ValueError(f"{len(cameras)} cameras: there must be some, of one size")
    parts, degree, channels = _parts(colors, sh, len(means))
    own = (means, quats, scales, opacities)
    models = [Gaussians(*own, part.sh[:, :1], part.sh[:, 1:], exact=exact) for part in parts]
    screen = means.new_zeros(len(cameras), len(means), 2).requires_grad_(_learn(models))
    views = []
    for camera, places in zip(cameras, screen, strict=True):
        drawn = [render(model, camera, sh_degree=degree, near=near, screen=places) for model in models]
        views.append(_view(parts, drawn, channels))
    color, alpha, inverse_depth, visible = map(torch.stack, zip(*views, strict=True))
    color = _over(color, alpha, background)
    return Raster(color, alpha, inverse_depth, screen, visible, tuple(cameras))


def _learn(models: list[Gaussians]) -> bool:
    """Whether a parameter of the models gets a gradient."""
    parameters = (tensor for model in models for tensor in model.tensors().values())
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in parameters)


def _over(color: Tensor, alpha: Tensor, background: Tensor | None) -> Tensor:
    """(C, H, W, X) colours over a background (X,) or (C, X)."""
    count, *_, channels = color.shape
    if background is None:
        return color
    if background.shape not in ((channels,), (count, channels)):
        raise ValueError(f"background is {tuple(background.shape)}, must have {channels} channels")
    return color + (1 - alpha[..., None]) * background.reshape(-1, 1, 1, channels)


class _Part(NamedTuple):
    """Three channels as spherical harmonics, and what their image is multiplied by and begins at."""

    sh: Tensor  # (N, 16, 3)
    span: Tensor | None = None  # (3,)
    least: Tensor | None = None  # (3,)

    def of(self, image: Tensor, alpha: Tensor) -> Tensor:
        """(H, W, 3) the channels that an image of this part shows."""
        if self.span is None or self.least is None:
            return image
        return image * self.span + alpha[..., None] * self.least


def _parts(colors: Tensor | None, sh: Tensor | None, count: int) -> tuple[list[_Part], int, int]:
    """What is drawn, three channels each; the degree of its spherical harmonics; the number of channels."""
    if colors is not None and sh is None:
        return _features(colors, count)
    if sh is not None and colors is None:
        return _harmonics(sh, count)
    raise ValueError("give either colors or sh")


def _harmonics(sh: Tensor, count: int) -> tuple[list[_Part], int, int]:
    fits = sh.dim() == 3 and sh.shape[0] == count and sh.shape[1] in _DEGREES and sh.shape[2] == 3
    if not fits or sh.dtype != torch.float32:
        raise ValueError(f"sh is {sh.dtype} {tuple(sh.shape)}, must be float32 ({count}, 1, 4, 9 or 16, 3)")
    padding = sh.new_zeros(len(sh), SH_REST + 1 - sh.shape[1], 3)
    return [_Part(torch.cat([sh, padding], 1))], _DEGREES[sh.shape[1]], 3


def _features(colors: Tensor, count: int) -> tuple[list[_Part], int, int]:
    """The kernels clamp a Gaussian's colour at 0, so each channel is moved and scaled to lie above it: an
    image has alpha times what was subtracted.
    """
    fits = colors.dim() == 2 and colors.shape[0] == count and colors.shape[1] > 0
    if not fits or colors.dtype != torch.float32:
        raise ValueError(f"colors is {colors.dtype} {tuple(colors.shape)}, must be float32 ({count}, X)")
    channels = colors.shape[1]
    colors = torch.nn.functional.pad(colors, (0, -channels % 3))
    parts = []
    for three in torch.split(colors, 3, dim=1):
        values = three.detach()
        finite = torch.where(values.isfinite(), values, 0) if count else values.new_zeros(1, 3)
        least, span = finite.amin(0), finite.amax(0) - finite.amin(0)
        span = torch.where(span > 0, span, least.abs().clamp(min=_LEAST))
        least = least - _MARGIN * span
        flat = ((three - least) / span - 0.5) / SH_C0
        parts.append(_Part(torch.cat([flat[:, None], flat.new_zeros(count, SH_REST, 3)], 1), span, least))
    return parts, 0, channels


def _view(parts: list[_Part], drawn: list[Render], channels: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(H, W, X) colours, (H, W) alpha and inverse depth, and (N,) what is visible, of what was drawn."""
    first = drawn[0]
    color = [part.of(each.color, each.alpha) for part, each in zip(parts, drawn, strict=True)]
    return torch.cat(color, -1)[..., :channels], first.alpha, first.inverse_depth, first.visible
