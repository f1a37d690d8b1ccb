"""Rendering: Gaussians and a camera in, an equirectangular image out (eq. 1)."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.baked import Baked
from panolog.renderer.camera import Camera
from panolog.renderer.motion import MOTION, MOTION_SUMS
from panolog.scene.gaussians import Gaussians

_JPEG_QUALITY = 85
SH_DEGREE = 3  # of finished models; lower degrees are padded with zeros


class Render(NamedTuple):
    """One rendered panorama. H = W / 2 rows from the zenith (top) to the nadir."""

    color: Tensor  # (H, W, 3) over black, not clamped above
    alpha: Tensor  # (H, W) accumulated, 1 - transmittance
    inverse_depth: Tensor  # (H, W) Σ (1/r) α T, not normalised by alpha; 1 / world units
    visible: Tensor  # (N,) bool: its footprint overlaps the image, hidden or not (radii > 0 of 3DGS)
    invalid: Tensor  # (N,) bool: not drawn: not finite, out of the range of float32, or without rotation


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int = 3,
    near: float = 0.0,
    screen: Tensor | None = None,
    exterior: Baked | None = None,
    motion: Tensor | None = None,
) -> Render:
    """Rasterize N Gaussians into an equirectangular panorama (eqs. 1, 2 and appendix B of the paper).

    Those with `exact` are seen along the ray of each pixel in place of eq. 2 (csrc/rays.h).

    Differentiable in every tensor of `gaussians` and in the camera's pose. Footprints wrap at ±180°.

    Args:
        gaussians: N Gaussians, float32, on the device that renders.
        camera: pose and size, on any device: a card takes the pose by value.
        sh_degree: 0 to 3, how many degrees of spherical harmonics take part.
        near: radial distance in world units below which a Gaussian is not drawn.
        screen: (N, 2) zeros that require grad; receives ∂L/∂(u, v) per pixel, which densification needs. With
            `gaussians.exact` it only receives: values other than 0 do not move them. Without it two more
            columns may receive sums of |∂L/∂(u, v)| over pixels: absolute gradients (Ye et al. 2024).
        exterior: what else the camera sees, baked for it; the image is then empty outside of its tiles.
        motion: (27,) float64 zeros that require grad; receives how the loss changes as the camera moves,
            `motion.Motion.of`, in place of the pose.

    Raises:
        ValueError: shapes or types do not fit, or `sh_degree` is not in 0..3.

    >>> import panolog
    >>> scene = panolog.read_scene(SCENE)
    >>> panolog.render(panolog.read_ply(MODEL), panolog.Camera.at(scene.panoramas[0], 64)).color.shape
    torch.Size([32, 64, 3])
    """
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree is {sh_degree}, must be 0 to 3")
    if screen is None:
        screen = gaussians.means.new_zeros((len(gaussians), 2))
    _check_tensors(gaussians, screen)
    _check_camera(camera)
    color, alpha, inverse_depth, state, *_ = ops.rasterize(
        **gaussians.tensors(),
        screen=screen,
        rotation=camera.rotation.detach(),
        translation=camera.translation.detach(),
        width=camera.width,
        height=camera.height,
        sh_degree=sh_degree,
        near=near,
        exact=gaussians.exact,
        exterior=[] if exterior is None else exterior.arrays(),
        motion=_motion(motion, camera, gaussians.means.device),
    )
    return Render(color, alpha, inverse_depth, visible=state == ops.VISIBLE, invalid=state == ops.INVALID)


class PoseGradient(torch.autograd.Function):
    """The gradients of a pose from how the loss changes as the camera moves (`motion.Motion`).

    With X_cam = R X + t, a turn ω moves the pose by δR = [ω]× R and δt = ω × t. Of the gradients g_τ and g_ω
    of the motion, that of t is g_τ, and that of R is ½ [g_ω − t × g_τ]× R: its product with each such δR is
    the change of the loss. So it is exact for rotations however they are parametrised, and has no part that
    would leave them.
    """

    @staticmethod
    def forward(ctx: Any, rotation: Tensor, translation: Tensor, device: torch.device) -> Tensor:
        """(27,) zeros for `render`. Args: rotation (3, 3), translation (3,), device of the Gaussians."""
        ctx.save_for_backward(rotation, translation)
        return torch.zeros(MOTION_SUMS, dtype=torch.float64, device=device)

    @staticmethod
    def backward(ctx: Any, sums: Tensor) -> tuple[Tensor, Tensor, None]:
        """The gradients of rotation and translation."""
        rotation, translation = ctx.saved_tensors
        shift, turn = sums.to(rotation.device)[:MOTION].view(2, 3)
        x, y, z = turn - torch.linalg.cross(translation.double(), shift)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
        return (cross @ rotation.double() / 2).to(rotation), shift.to(translation), None


def _motion(motion: Tensor | None, camera: Camera, device: torch.device) -> Tensor | None:
    """What receives the gradient of the camera: that which is given, or `PoseGradient` of its pose."""
    if motion is not None:
        if motion.shape != (MOTION_SUMS,) or motion.dtype != torch.float64:
            found = f"{motion.dtype} {tuple(motion.shape)}"
            raise ValueError(f"motion is {found}, must be float64 ({MOTION_SUMS},)")
        return motion
    if not (camera.rotation.requires_grad or camera.translation.requires_grad):
        return None
    sums: Tensor = PoseGradient.apply(camera.rotation, camera.translation, device)  # type: ignore[no-untyped-call]
    return sums


def _check_tensors(gaussians: Gaussians, screen: Tensor) -> None:
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    columns = 4 if screen.shape[1:] == (4,) and not gaussians.exact else 2
    for name, tensor in {**gaussians.tensors(), "screen": screen}.items():
        expected = (len(gaussians), *shapes.get(name, (columns,)))
        if tensor.shape != expected or tensor.dtype != torch.float32:
            raise ValueError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, must be float32 {expected}")


def _check_camera(camera: Camera) -> None:
    pose = (camera.rotation, camera.translation)
    if [tuple(t.shape) for t in pose] != [(3, 3), (3,)] or any(t.dtype != torch.float32 for t in pose):
        raise ValueError("the camera's rotation and translation must be float32 (3, 3) and (3,)")
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"the image is {camera.width} x {camera.height}, must be at least one pixel")


def to_bytes(color: torch.Tensor) -> NDArray[np.uint8]:
    """(H, W, 3) colours to uint8: clamped to [0, 1] and rounded, as 3DGS saves its renders."""
    image: NDArray[np.uint8] = _quantized(color).cpu().numpy()
    return image


def _quantized(color: Tensor) -> Tensor:
    return (color.clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """(H, W, 3) RGB as the bytes of a PNG file."""
    return bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1])


def encode_jpeg(image: NDArray[np.uint8], widest: int) -> bytes:
    """(H, W, 3) RGB, reduced to at most `widest` pixels, as the bytes of a JPEG file."""
    height, width = image.shape[:2]
    if width > widest:
        size = (widest, height * widest // width)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def hatched(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) an image, pale and under diagonal lines: what is not rendered."""
    height, width = image.shape[:2]
    period = max(width // 48, 6)
    lines = np.add.outer(np.arange(height), np.arange(width)) % period < period // 3
    return np.where(lines[..., None], 232, image // 3 + 96).astype(np.uint8)


def render_panorama(
    gaussians: Gaussians,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    width: int,
    near: float,
) -> NDArray[np.uint8]:
    """`render_bytes` as an array."""
    image: NDArray[np.uint8] = render_bytes(gaussians, rotation, translation, width, near).cpu().numpy()
    return image


def render_bytes(
    gaussians: Gaussians,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    width: int,
    near: float,
) -> Tensor:
    """A panorama (width / 2, width, 3) uint8 RGB of a model, on the device that the model is on.

    Args: rotation (3, 3) and translation (3,) world-to-camera; width in pixels, even; near in world units.
    """
    camera = Camera.of(rotation, translation, width, width // 2)
    with torch.no_grad():
        return _quantized(render(gaussians, camera, sh_degree=SH_DEGREE, near=near).color)
