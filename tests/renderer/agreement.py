"""Whether kernels agree with a definition or with other kernels, except for the rounding of float32."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.motion import MOTION, MOTION_SUMS, Motion
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import Gaussians
from tests.renderer.hard_scenes import as_leaves, decided, wide
from tests.renderer.reference import render_reference
from tests.renderer.reference_rays import decided_rays, render_rays

NEAR = 0.02
IMAGES = ("color", "alpha", "inverse_depth")
PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN", "screen")


def certain(scene: Gaussians, at: Camera) -> Tensor:
    """(H, W) bool: the pixels on which rounding decides nothing; more than half of them all."""
    with torch.no_grad():
        decide = decided_rays if scene.exact else decided
        keep = decide(as_leaves(scene, torch.float64), wide(at), NEAR)
    assert keep.float().mean() > 0.5
    return keep


def random_weights(images: Sequence[Tensor], keep: Tensor) -> list[Tensor]:
    """Gradients of the images, 0 where `keep` (H, W) is not set."""
    rng = torch.Generator().manual_seed(1)
    weights = [torch.randn(image.shape, generator=rng, dtype=image.dtype) for image in images]
    return [weight * (keep[..., None] if weight.dim() == 3 else keep) for weight in weights]


def check_images(ours: Sequence[Tensor], truth: Sequence[Tensor], keep: Tensor) -> None:
    """`IMAGES`, with which both begin, where `keep` (H, W) is set."""
    for name, one, two in zip(IMAGES, ours, truth, strict=False):
        difference = (one - two)[keep].abs().max().item()
        assert difference < 1e-4 * max(1.0, two.abs().max().item()), name


def check_gradients(ours: Sequence[Tensor | None], truth: Sequence[Tensor | None]) -> None:
    """Those of `PARAMETERS`."""
    for name, one, two in zip(PARAMETERS, ours, truth, strict=True):
        assert one is not None and two is not None, name
        assert (one - two).norm() <= 1e-3 * two.norm(), name
        assert (one - two).abs().max() <= 1e-3 * two.abs().max(), name


class Truth(NamedTuple):
    """What the definition says of N Gaussians in float64."""

    images: Render
    keep: Tensor  # (H, W) bool, `certain`
    weights: list[Tensor]  # the gradients of the images, for which there are
    gradients: list[Tensor | None]  # those of `PARAMETERS`
    motions: NDArray[np.float64]  # (N, 6) dL/d(τ, ω) that each has in the camera's motion


def truth_of(scene: Gaussians, at: Camera, degree: int) -> Truth:
    """The definition of the scene's projection: values and gradients."""
    definition = render_rays if scene.exact else render_reference
    keep, leaves = certain(scene, at), as_leaves(scene, torch.float64)
    screen = torch.zeros(len(scene), 2, dtype=torch.float64, requires_grad=True)
    motion = torch.zeros(len(scene), MOTION, dtype=torch.float64, requires_grad=True)
    made = definition(leaves, wide(at), sh_degree=degree, near=NEAR, screen=screen, motion=motion)
    weights = random_weights(made[:3], keep)
    torch.autograd.backward(list(made[:3]), weights)
    assert motion.grad is not None
    gradients = [leaf.grad for leaf in (*leaves.tensors().values(), screen)]
    return Truth(Render(*(image.detach() for image in made)), keep, weights, gradients, motion.grad.numpy())


def check_definition(
    scene: Gaussians, at: Camera, degree: int, device: str = "cpu", truth: Truth | None = None
) -> None:
    """The kernels of a device against the definition, which may have been computed before.

    On a card without motions: tests/renderer/cuda compares these with those of the CPU.
    """
    truth = truth or truth_of(scene, at, degree)
    leaves = as_leaves(scene.to(device), torch.float32)
    screen = torch.zeros(len(scene), 2, device=device, requires_grad=True)
    motion = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True) if device == "cpu" else None
    made = render(leaves, at.to(device), sh_degree=degree, near=NEAR, screen=screen, motion=motion)
    ours = Render(*(tensor.cpu() for tensor in made))
    check_images(ours, truth.images, truth.keep)
    assert not (truth.images.visible & ~ours.visible).any()
    torch.autograd.backward(list(made[:3]), [weight.to(device, torch.float32) for weight in truth.weights])
    found = [leaf.grad for leaf in (*leaves.tensors().values(), screen)]
    check_gradients([None if gradient is None else gradient.cpu() for gradient in found], truth.gradients)
    if motion is not None:
        assert motion.grad is not None
        check_motion(Motion.of(motion.grad.numpy()), truth.motions)


def check_motion(found: Motion, parts: NDArray[np.float64]) -> None:
    """The sums of a camera's motion against the parts (N, 6) that single Gaussians have in them."""
    size = np.abs(parts).sum(0)
    assert (np.abs(found.gradient - parts.sum(0)) <= 1e-3 * size + 1e-6 * size.max()).all()
    moments = parts.T @ parts
    assert np.linalg.norm(found.moments - moments) <= 2e-3 * np.linalg.norm(moments)
