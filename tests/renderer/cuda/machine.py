"""Where kernels run, and what their results must be: those of the CPU."""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.adam import BETAS, Moving
from panolog.renderer.baked import FAINT, SLACK, Baked, bake
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import launches, parts
from panolog.renderer.cuda.baking import WEIGHT_UNITS, weights_of
from panolog.renderer.cuda.iteration import REPORT, Problem, Status, take
from panolog.renderer.cuda.motion import motion_sums
from panolog.renderer.cuda.parts import Launch
from panolog.renderer.motion import MOTION, MOTION_SUMS, Motion
from panolog.scene.gaussians import PARAMETERS, SH_C0, Gaussians
from tests.renderer.agreement import IMAGES, NEAR, certain, check_gradients, check_images, random_weights
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.test_adam import by_autograd, clones, defined, grads, moving_of, problem_of

AFFINE = torch.tensor([[0.7, 1.0, 1.3], [0.02, 0.0, -0.03]])  # an exposure


@dataclass(frozen=True)
class Machine:
    """Where kernels run."""

    launch: Launch
    device: str
    watching: Callable[[], AbstractContextManager[Any]] = nullcontext

    def run(self, op: Callable[..., Any], **arguments: Any) -> Any:
        """One of the sequences of `renderer.cuda` with the arguments of its op: here and back."""
        moved = {name: self.moved(argument) for name, argument in arguments.items()}
        with self.watching():
            result = op(self.launch, **moved)
        return None if result is None else [tensor.cpu() for tensor in result]

    def moved(self, argument: Any) -> Any:
        """A tensor, or those of a sequence, here; anything else as it is."""
        if type(argument) in (list, tuple):
            return type(argument)(self.moved(each) for each in argument)
        return argument.to(self.device) if isinstance(argument, Tensor | Baked) else argument


def emulated(launch: EmulatedLaunch) -> Machine:
    return Machine(launch, "cpu", launch.watching)


def arguments(scene: Gaussians, at: Camera, degree: int = 3, exterior: Baked | None = None) -> dict[str, Any]:
    """What `ops.rasterize` takes."""
    screen = torch.zeros(len(scene), 2)
    settings = {"sh_degree": degree, "near": NEAR, "exact": scene.exact}
    around = [] if exterior is None else exterior.arrays()
    return {**scene.tensors(), "screen": screen, **vars(at), **settings, "exterior": around}


def results(forward: Sequence[Tensor], weights: list[Tensor]) -> dict[str, Any]:
    """What `ops.rasterize_backward` takes beyond that: what `ops.rasterize` returned, and gradients."""
    images = dict(zip(IMAGES, forward, strict=False))
    grads = {f"grad_{name}": weight for name, weight in zip(images, weights, strict=True)}
    return {**images, **grads, "frame": list(forward[4:])}


def surrounded(scene: Gaussians, at: Camera, own: Tensor) -> tuple[Gaussians, Baked]:
    """Some rows of a scene, and what a camera sees of the others."""
    whole = own_first(scene, own)
    block = whole.with_tensors({name: tensor[: len(own)] for name, tensor in whole.tensors().items()})
    return block, bake(whole, len(own), at, near=NEAR, unit=1.0)


def own_first(scene: Gaussians, own: Tensor) -> Gaussians:
    """A scene with the rows `own` first, and the others after them."""
    rows = torch.arange(len(scene))
    order = torch.cat([own, rows[~torch.isin(rows, own)]])
    return scene.with_tensors({name: tensor[order] for name, tensor in scene.tensors().items()})


def to_bake(scene: Gaussians, at: Camera, own: int) -> dict[str, Any]:
    """What `ops.bake` takes."""
    settings = {"own": own, "sh_degree": 3, "near": NEAR, "exact": scene.exact}
    return {**scene.tensors(), **vars(at), **settings, "slack": SLACK, "faint": FAINT}


def check_baked(
    machine: Machine, scene: Gaussians, at: Camera, own: Tensor, keep: Tensor | None = None
) -> None:
    """What is before, among and behind some rows of a scene. Args: keep, `certain` of it."""
    whole = own_first(scene, own)
    given = to_bake(whole, at, len(own))
    *truth, spans, among, splats, rays = ops.bake(**given)
    *ours, our_spans, our_among, our_splats, our_rays = machine.run(launches.bake, **given)
    assert torch.allclose(our_spans, spans, rtol=1e-5, atol=0)
    assert torch.equal(our_among, among)
    assert (our_splats.shape, our_rays.shape) == (splats.shape, rays.shape)
    active = bake(whole, len(own), at, near=NEAR, unit=1.0).active(at.width, at.height)
    if active.any():
        keep = certain(whole, at) if keep is None else keep
        for first in (0, 3):
            check_images(ours[first : first + 3], truth[first : first + 3], keep & active)


def check_weights(machine: Machine, scene: Gaussians, at: Camera) -> None:
    """Checks each splat's weight in all tiles: the gradient of the sum of an image's red by its own red."""
    tensors, size = scene.tensors() | {"sh0": torch.ones_like(scene.sh0)}, (at.width, at.height)
    given = arguments(scene.with_tensors(tensors), at, 0)
    truth = ops.rasterize(**given)
    red = [torch.zeros_like(image) for image in truth[:3]]
    red[0][..., 0] = 1
    expected = (
        ops.rasterize_backward(**given, **results(truth, red))[PARAMETERS.index("sh0")][:, 0, 0] / SH_C0
    )
    camera = parts.camera_struct(at.rotation, at.translation, *size, NEAR, scene.exact)
    there = {name: machine.moved(tensor) for name, tensor in tensors.items()}
    angles = parts.half_pixels(*size, there["means"].device) if scene.exact else None
    spans = machine.moved(torch.tensor([0.0, 1.0]).repeat(math.prod(parts.tiles_of(*size)), 1))
    with machine.watching():
        screen = there["means"].new_zeros(len(scene), 2)
        projected = parts.project(machine.launch, there, screen, camera, 0, angles)
        pairs = parts.list_pairs(machine.launch, projected, *size)
        weights = weights_of(machine.launch, projected, pairs, *size, spans).double() / WEIGHT_UNITS
        found = weights.new_zeros(len(scene)).index_add(0, pairs.entries, weights)
        spans[:, 1] = -1
        assert not weights_of(machine.launch, projected, pairs, *size, spans).any()
    assert expected.any() and torch.allclose(found.cpu().float(), expected, rtol=1e-3, atol=1e-2)


def check_against_cpu(
    machine: Machine, scene: Gaussians, at: Camera, degree: int, keep: Tensor, exterior: Baked | None = None
) -> None:
    given = arguments(scene, at, degree, exterior)
    truth, ours = ops.rasterize(**given), machine.run(launches.rasterize, **given)
    check_images(ours, truth, keep)
    assert torch.equal(ours[3], truth[3])
    weights = random_weights(truth[:3], keep)
    for columns in (2,) if scene.exact else (2, 4):  # without and with absolute gradients
        given["screen"] = torch.zeros(len(scene), columns)
        *expected, motion = ops.rasterize_backward(**given, **results(truth, weights), moving=True)
        *found, our_motion = machine.run(
            launches.rasterize_backward, **given, **results(ours, weights), moving=True
        )
        check_gradients(found, expected)
        check_motion(our_motion, motion)


def check_motion(ours: Tensor, truth: Tensor) -> None:
    """Sums of motion; in a gradient large parts may cancel."""
    (gradient, moments), (expected, squares) = (Motion.of(sums.numpy()) for sums in (ours, truth))
    assert (np.abs(moments - squares) <= 2e-3 * np.abs(squares).max()).all()
    slack = 1e-3 * np.abs(expected) + 5e-3 * np.sqrt(squares.diagonal()) + 1e-6 * np.abs(expected).max()
    assert (np.abs(gradient - expected) <= slack).all()


def check_tiles(machine: Machine, scene: Gaussians, at: Camera, exterior: Baked | None = None) -> None:
    """Exact projection finds the pairs of splats and tiles of the CPU, all of them unless a card rounds."""
    given = arguments(scene, at, exterior=exterior)
    *_, slots, pairs, tiles = ops.rasterize(**given)
    *_, met, entries, starts = machine.run(launches.rasterize, **given)
    expected = pairs.view(-1, 3)[:, 0]  # rows, tile after tile
    if machine.device == "cpu":
        assert torch.equal(starts, tiles) and torch.equal(entries[: len(expected)], expected)
        assert exterior is not None or torch.equal(met, slots.diff())
    assert abs(int(starts[-1]) - len(expected)) <= 0.01 * len(expected)


def check_photometric(
    machine: Machine, size: tuple[int, int], *, masked: bool, weight: float, rows: bool, exposed: bool
) -> None:
    """The loss of an image (H, W), its gradient, and the sums of its exposure."""
    rng = torch.Generator().manual_seed(0)
    color = torch.rand(*size, 3, generator=rng) * 1.2
    target = torch.randint(0, 256, (*size, 3), generator=rng, dtype=torch.uint8)
    mask, some = torch.rand(size, generator=rng) > 0.3, torch.rand(size[0], generator=rng)
    given = {"color": color, "target": target, "mask": mask if masked else None, "lambda_ssim": weight}
    given |= {"rows": some if rows else None, "exposure": AFFINE if exposed else None}
    values, gradient, sums = ops.photometric(**given)
    ours, our_gradient, our_sums = machine.run(launches.photometric, **given)
    assert torch.allclose(ours, values, atol=1e-6, rtol=0)
    assert (our_gradient - gradient).norm() <= 1e-4 * gradient.norm()
    assert our_sums.shape == sums.shape == ((3, 5) if exposed else (0, 5))
    assert torch.allclose(our_sums, sums, rtol=1e-4, atol=1e-5)


def check_absolute_difference(machine: Machine, share: float) -> None:
    """Where a share of the pixels is valid."""
    rendered, target, chance = torch.rand(3, 20, 40, generator=torch.Generator().manual_seed(0))
    given = {"rendered": rendered, "target": target, "valid": chance < share}
    value, gradient = ops.absolute_difference(**given)
    ours, our_gradient = machine.run(launches.absolute_difference, **given)
    assert torch.allclose(ours, value, atol=1e-6, rtol=0)
    assert torch.allclose(our_gradient, gradient)


def check_step(
    machine: Machine, scene: Gaussians, exterior: Baked | None = None, *, absolute: bool = False
) -> None:
    """A step of some rows by the gradients of autograd: they are found in what the first moments become.

    Args: exterior, of `camera()`; absolute, whether the problem has absolute gradients.
    """
    rows = len(scene) // 2 + 30
    units = {name: torch.linspace(0.5, 2, len(scene)) for name in ("means", "shN")}
    problem = problem_of(scene, exterior=exterior, moving=True, absolute=absolute)
    keep, valid = certain(scene, problem.camera), problem.depth
    assert problem.mask is not None and valid is not None
    problem = replace(problem, mask=problem.mask & keep, depth=(valid[0], valid[1] & keep))
    screen = torch.zeros(len(scene), 4 if problem.absolute else 2, requires_grad=True)
    motion = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    expected = grads(by_autograd(problem, screen=screen, motion=motion)[0])
    before = moving_of(scene, rows, **units)
    mine = {name: Moving(*(machine.moved(part) for part in it)) for name, it in clones(before).items()}
    there = {name: machine.moved(value) for name, value in vars(problem).items() if name != "camera"}
    there["model"] = {name: it.parameter for name, it in mine.items()}
    status = Status(torch.device(machine.device))
    with machine.watching():
        given = Problem(**there, camera=problem.camera)
        found = take(machine.launch, given, mine, 7, status, None)
    after = {name: [part.cpu() for part in it[:3]] for name, it in mine.items()}
    seen = {  # rounded to a ten-millionth of what a moment was before
        name: (moment.double() - BETAS[0] * before[name].exp_avg.double()) / (1 - BETAS[0])
        for name, (_, moment, _) in after.items()
    }
    check_gradients(
        [*(seen[name][:rows] for name in PARAMETERS), found.screen.cpu()],
        [*(expected[name][:rows] for name in PARAMETERS), by(screen)[:, :2]],
    )
    if found.absolute is not None:
        assert torch.allclose(found.absolute.cpu(), by(screen)[:, 2:], rtol=1e-3, atol=1e-9)
    check_motion(found.report[REPORT:].cpu(), by(motion))
    assert int(found.report[REPORT - 1]) == int(status.known) == int(status.broken) == 0
    for name, wanted in defined(before, seen, 7).items():
        for ours, then, now in zip(after[name], before[name][:3], wanted, strict=True):
            assert (ours - now)[:rows].abs().max() <= 2e-6 * now.abs().max(), name
            assert torch.equal(ours[rows:], then[rows:]), name


def by(leaf: Tensor) -> Tensor:
    """The gradient of a leaf of autograd."""
    assert leaf.grad is not None
    return leaf.grad


def check_motion_sums(machine: Machine, count: int) -> None:
    """Of so many motions: of several blocks, the last of them in part."""
    motion = torch.randn(count, MOTION, generator=torch.Generator().manual_seed(0))
    with machine.watching():
        sums = motion_sums(machine.launch, motion.to(machine.device)).cpu()
    gradient, moments = Motion.of(sums.numpy())
    wide = motion.double().numpy()
    assert np.allclose(gradient, wide.sum(0), rtol=1e-12, atol=1e-11)
    assert np.allclose(moments, wide.T @ wide, rtol=1e-12, atol=1e-11)
