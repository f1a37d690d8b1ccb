"""Whether kernels agree with a definition or with other kernels, except for the rounding of float32."""

from collections.abc import Sequence

import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import Gaussians
from tests.renderer.hard_scenes import as_leaves, decided, wide
from tests.renderer.reference import render_reference
from tests.renderer.reference_rays import decided_rays, render_rays

NEAR = 0.02
IMAGES = ("color", "alpha", "inverse_depth")
PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN", "screen")


def certain(scene: Gaussians, at: Camera) -> Tensor:
    """(H, W) bool: the pixels on which rounding decides nothing."""
    if not scene.exact:
        return decided(scene, at, NEAR)
    with torch.no_grad():
        return decided_rays(as_leaves(scene, torch.float64), wide(at), NEAR)


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


def check_definition(scene: Gaussians, at: Camera, degree: int, device: str = "cpu") -> None:
    """The kernels of a device against the definition of the scene's projection: values and gradients."""
    definition = render_rays if scene.exact else render_reference
    keep = certain(scene, at)
    assert keep.float().mean() > 0.5
    true_leaves, leaves = as_leaves(scene, torch.float64), as_leaves(scene.to(device), torch.float32)
    true_screen = torch.zeros(len(scene), 2, dtype=torch.float64, requires_grad=True)
    screen = torch.zeros(len(scene), 2, device=device, requires_grad=True)
    truth = definition(true_leaves, wide(at), sh_degree=degree, near=NEAR, screen=true_screen)
    made = render(leaves, at.to(device), sh_degree=degree, near=NEAR, screen=screen)
    ours = Render(*(tensor.cpu() for tensor in made))
    check_images(ours, truth, keep)
    assert not (truth.visible & ~ours.visible).any()

    weights = random_weights(truth[:3], keep)
    for rendered in (truth, ours):
        _weighted(rendered, weights).backward()  # type: ignore[no-untyped-call]
    expected = [leaf.grad for leaf in (*true_leaves.tensors().values(), true_screen)]
    found = [leaf.grad for leaf in (*leaves.tensors().values(), screen)]
    check_gradients([None if gradient is None else gradient.cpu() for gradient in found], expected)


def _weighted(rendered: Render, weights: list[Tensor]) -> Tensor:
    parts = zip(rendered[:3], weights, strict=True)
    return torch.stack([(image * weight.to(image.dtype)).sum() for image, weight in parts]).sum()
