"""A training iteration on the CPU, whose backward pass takes the step of Adam, against autograd and torch."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from panolog.renderer.adam import Moving
from panolog.renderer.baked import bake
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.iteration import backward, forward, loss_of, take
from panolog.renderer.losses import inverse_depth_loss, photometric_loss
from panolog.renderer.motion import MOTION_SUMS
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import PARAMETERS, Gaussians
from tests.renderer.agreement import NEAR
from tests.renderer.hard_scenes import as_leaves, camera, cloud

COUNT = 1500  # Gaussians: two spans of the kernels, the second one shorter
RATES = dict(zip(PARAMETERS, (1e-3, 2e-3, 5e-3, 5e-2, 3e-3, 2e-4), strict=True))


def problem_of(model: Gaussians, **more: Any) -> Problem:
    """An image of noise, with all that a problem may have."""
    at, rng = camera(), torch.Generator().manual_seed(3)
    size = (at.height, at.width)
    given: dict[str, Any] = {
        "image": torch.randint(0, 256, (*size, 3), generator=rng, dtype=torch.uint8),
        "mask": torch.rand(size, generator=rng) > 0.2,
        "share": torch.tensor(0.7, dtype=torch.float64),
        "depth": (torch.rand(size, generator=rng), torch.rand(size, generator=rng) > 0.3),
        "depth_share": torch.tensor(0.3, dtype=torch.float64),
        "depth_weight": 0.5,
        "lambda_ssim": 0.2,
        "rows": None,
        "sh_degree": 3,
        "near": NEAR,
        "exact": model.exact,
    }
    return Problem(**{"model": model.tensors(), "camera": at, **given, **more})


def moving_of(model: Gaussians, rows: int | None = None, **units: Tensor) -> dict[str, Moving]:
    """All parameters with moments that are not 0; of each the first `rows` rows."""
    rng = torch.Generator().manual_seed(4)
    return {
        name: Moving(
            it,
            torch.randn(it.shape, generator=rng) * 1e-4,
            torch.rand(it.shape, generator=rng) * 1e-8,
            it[:rows].numel(),
            RATES[name],
            units.get(name),
        )
        for name, it in model.tensors().items()
    }


def by_autograd(
    problem: Problem, screen: Tensor | None = None, motion: Tensor | None = None
) -> tuple[Gaussians, Render, Tensor]:
    """Leaves with their gradients, the image, and the loss."""
    tensors = dict(problem.model)
    leaves = as_leaves(replace(cloud(1).with_tensors(tensors, 0), exact=problem.exact), torch.float32)
    made = render(
        leaves,
        problem.camera,
        sh_degree=problem.sh_degree,
        near=NEAR,
        screen=screen,
        exterior=problem.exterior,
        motion=motion,
    )
    loss = photometric_loss(made.color, problem.image, problem.mask, problem.lambda_ssim).loss
    assert problem.share is not None and problem.depth is not None and problem.depth_share is not None
    by_depth = inverse_depth_loss(made.inverse_depth, *problem.depth) * problem.depth_weight
    loss = loss * problem.share + by_depth * problem.depth_share
    loss.backward()  # type: ignore[no-untyped-call]
    return leaves, made, loss.detach()


def defined(
    before: Mapping[str, Moving], gradients: Mapping[str, Tensor], step: int
) -> dict[str, list[Tensor]]:
    """Algorithm 1 in float64, on all rows, with the kernels' constants in float32."""
    first, second = torch.tensor([0.9, 0.999]).double().tolist()
    after = {}
    for name, (*tensors, _, lr, units) in before.items():
        parameter, m, v = (tensor.double() for tensor in tensors)
        g = gradients[name].double()
        m, v = first * m + (1 - first) * g, second * v + (1 - second) * g * g
        rate = lr if units is None else lr * units.double().view(-1, *[1] * (g.dim() - 1))
        root = (v / (1 - second**step)).sqrt() + 1e-15
        after[name] = [parameter - rate * (m / (1 - first**step)) / root, m, v]
    return after


def grads(leaves: Gaussians) -> dict[str, Tensor]:
    return {name: it.grad for name, it in leaves.tensors().items() if it.grad is not None}


def clones(moving: Mapping[str, Moving]) -> dict[str, Moving]:
    return {
        name: it._replace(
            parameter=it.parameter.clone(), exp_avg=it.exp_avg.clone(), exp_avg_sq=it.exp_avg_sq.clone()
        )
        for name, it in moving.items()
    }


@pytest.mark.parametrize("kind", ["affine", "absolute", "exact", "among an exterior"])
def test_a_step_is_that_of_the_gradients_of_autograd(kind: str, instruction_set: str) -> None:
    """Also of rows without one: their moments decay, and move them. What else is learnt has equal bytes."""
    whole = replace(cloud(COUNT), exact=kind not in ("affine", "absolute"))
    model, around = whole, None
    if kind == "among an exterior":
        around = bake(whole, 900, camera(), near=NEAR, unit=1.0)
        model = whole.select(torch.arange(COUNT) < 900)
    problem = problem_of(model, exterior=around, moving=True, absolute=kind == "absolute")
    screen = torch.zeros(len(model), 4 if kind == "absolute" else 2, requires_grad=True)
    motion = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    leaves, made, loss = by_autograd(problem, screen=screen, motion=motion)
    moving = moving_of(model, means=torch.rand(len(model)), shN=torch.rand(len(model)))
    expected = defined(clones(moving), grads(leaves), 7)
    seen, found, learnt = take(problem, moving, 7, screen=True)
    assert found.value == loss.item() and torch.equal(seen.color, made.color.detach())
    for ours, truth in ((learnt.screen, screen.grad), (learnt.motion, motion.grad)):
        assert ours is not None and truth is not None and torch.equal(ours, truth)
    still = ~(grads(leaves)["opacities"] != 0)
    assert 0 < int(still.sum()) < len(model)
    for name, after in expected.items():
        for ours, truth in zip(moving[name][:3], after, strict=True):
            assert (ours - truth).abs().max() <= 2e-6 * truth.abs().max(), name
    assert take(problem, moving, 8, screen=False).learnt.screen is None


def test_it_is_torchs_adam() -> None:
    model = cloud(200)
    problem = problem_of(model)
    zeros = {
        name: Moving(it, torch.zeros_like(it), torch.zeros_like(it), it.numel(), RATES[name])
        for name, it in model.tensors().items()
    }
    theirs = {name: it.clone().requires_grad_() for name, it in model.tensors().items()}
    optimizer = torch.optim.Adam(
        [{"params": [it], "lr": RATES[name]} for name, it in theirs.items()], eps=1e-15
    )
    for step in range(1, 6):
        for name, it in theirs.items():  # gradients where ours are: else rounding would part them
            it.grad = grads(by_autograd(problem)[0])[name]
        optimizer.step()
        take(problem, zeros, step, screen=False)
        for name, it in theirs.items():
            torch.testing.assert_close(problem.model[name], it.detach(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("rows", [0, 30, 1024, 1100, COUNT])
def test_rows_and_parameters_that_take_no_part_keep_everything(rows: int) -> None:
    model = cloud(COUNT)
    moving = {name: it for name, it in moving_of(model, rows).items() if name != "quats"}
    kept, before = model.quats.clone(), clones(moving)
    take(problem_of(model), moving, 2, screen=False)
    assert torch.equal(model.quats, kept)
    for name, (*tensors, _, _, _) in moving.items():
        for now, then in zip(tensors, before[name][:3], strict=True):
            assert torch.equal(now[rows:], then[rows:]), name
            assert rows == 0 or not torch.equal(now[:rows], then[:rows]), name


def test_what_is_not_finite_is_named_and_the_loss_before_anything_moves() -> None:
    model = cloud(COUNT)
    problem, moving = problem_of(model), moving_of(model)
    seen = forward(problem)
    sound = loss_of(problem, seen.color, seen.inverse_depth)
    broken = sound._replace(by_color=torch.full_like(sound.by_color, math.inf))
    with pytest.raises(FloatingPointError, match="gradient of means"):
        backward(problem, seen, broken, clones(moving), 1, screen=False)
    with pytest.raises(FloatingPointError, match="gradient of sh0"):
        only = {name: it for name, it in clones(moving).items() if name in ("sh0", "shN")}
        backward(problem, seen, broken, only, 1, screen=False)
    before = clones(moving)
    dark = replace(problem, depth_weight=math.inf)
    with pytest.raises(FloatingPointError, match=r"^loss$"):
        take(dark, moving, 1, screen=False)
    for name, it in moving.items():
        assert all(torch.equal(*pair) for pair in zip(it[:3], before[name][:3], strict=True)), name


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"exp_avg": torch.ones(5, 3)}, "one shape"),
        ({"exp_avg_sq": torch.ones(20, 3).double()}, "float32"),
        ({"exp_avg": torch.ones(3, 20).T}, "contiguous"),
        ({"units": torch.ones(20, 3)}, "units of means must be"),
        ({"values": 61}, "within 0 to 60"),
        ({"values": -1}, "within 0 to 60"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, Any], words: str) -> None:
    model = cloud(20)
    moving = moving_of(model)
    with pytest.raises(ValueError, match=words):
        take(problem_of(model), moving | {"means": moving["means"]._replace(**change)}, 1, screen=False)
    with pytest.raises(ValueError, match="step 0"):
        take(problem_of(model), moving, 0, screen=False)
