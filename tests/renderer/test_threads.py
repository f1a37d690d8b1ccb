"""Images, losses and gradients: the same bytes with any number of threads."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.baked import Baked, bake
from panolog.renderer.iteration import take
from panolog.renderer.losses import inverse_depth_loss, photometric_loss
from panolog.renderer.motion import MOTION_SUMS
from panolog.renderer.render import render
from tests.renderer.agreement import NEAR
from tests.renderer.hard_scenes import as_leaves, camera, cloud
from tests.renderer.test_adam import moving_of, problem_of


def rendering(exact: bool, own: int | None = None) -> list[Tensor]:
    """The images of a scene and all that it learns from them; with `own` among the rest of it, baked."""
    at, scene = camera(256), replace(cloud(3000), exact=exact)
    exterior: Baked | None = None
    if own is not None:
        exterior = bake(scene, own, at, near=NEAR, unit=1.0)
        scene = scene.select(torch.arange(len(scene)) < own)
    leaves = as_leaves(scene, torch.float32)
    screen = torch.zeros(len(scene), 2, requires_grad=True)
    motion = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    made = render(leaves, at, near=NEAR, screen=screen, motion=motion, exterior=exterior)
    (made.color.square().sum() + made.inverse_depth.sum()).backward()  # type: ignore[no-untyped-call]
    learning = (*leaves.tensors().values(), screen, motion)
    learnt = [tensor.grad for tensor in learning if tensor.grad is not None and tensor.grad.any()]
    assert len(learnt) == len(learning)
    return [*made[:3], *learnt, *(exterior.arrays() if exterior else [])]


def losses(exposure: Tensor | None, mask: Callable[[Tensor], Tensor]) -> list[Tensor]:
    """The losses of an image where a mask is set, made from random numbers (H, W), and its gradient."""
    rng = torch.Generator().manual_seed(0)
    leaf = torch.rand(192, 384, 3, generator=rng).requires_grad_()
    target = torch.randint(0, 256, leaf.shape, generator=rng, dtype=torch.uint8)
    on = mask(torch.rand(192, 384, generator=rng))
    found = photometric_loss(leaf, target, on, 0.2, None, exposure)
    total = found.loss + inverse_depth_loss(leaf[..., 0], leaf[..., 1].detach(), on)
    total.backward()  # type: ignore[no-untyped-call]
    assert leaf.grad is not None
    return [total.detach(), *found[1:4], leaf.grad, *([] if found.exposure is None else [found.exposure])]


def scattered(chance: Tensor) -> Tensor:
    """Parts of an image, of which the last is over the seam."""
    mask = torch.zeros_like(chance, dtype=torch.bool)
    mask[10:180, 60:80] = mask[130:, 150:330] = mask[90:170, 374:] = mask[90:170, :9] = True
    return mask


def step() -> list[Tensor]:
    """A training iteration of three spans of Gaussians, the last of them shorter."""
    model = cloud(3000)
    moving = moving_of(model)
    seen, _, learnt = take(problem_of(model, moving=True), moving, 3, screen=True)
    assert learnt.screen is not None and learnt.motion is not None
    return [seen.color, learnt.screen, learnt.motion, *(each for it in moving.values() for each in it[:3])]


AFFINE = torch.tensor([[0.6, 1.0, 1.4], [0.03, 0.0, -0.05]])
WORKS: dict[str, Callable[[], list[Tensor]]] = {
    "affine": lambda: rendering(exact=False),
    "exact": lambda: rendering(exact=True),
    "among an exterior": lambda: rendering(exact=True, own=400),
    "losses": lambda: losses(None, lambda chance: chance > 0.3),
    "losses of parts": lambda: losses(None, scattered),
    "exposed": lambda: losses(AFFINE, lambda chance: chance > 0.3),
    "a step": step,
}


@pytest.mark.parametrize("name", WORKS)
def test_any_number_of_threads_gives_the_same_bytes(name: str) -> None:
    found = []
    for threads in (1, 2, 3):
        ops.use_threads(threads)
        try:
            found.append([tensor.detach().numpy().tobytes() for tensor in WORKS[name]()])
        finally:
            ops.use_threads(None)
    assert found[0] == found[1] == found[2]
