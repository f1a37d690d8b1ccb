"""How the loss changes as the camera moves: the kernels against the definition and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.motion import MOTION, MOTION_SUMS, Motion, moved
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians
from tests.renderer.agreement import NEAR, certain, random_weights
from tests.renderer.hard_scenes import as_leaves, camera, cloud, scenes, wide
from tests.renderer.reference import MOTION_POLE, render_reference, seen
from tests.renderer.reference_rays import render_rays

SCENES = [(name, exact) for exact in (False, True) for name in scenes(camera(), exact)]


def parts_of(scene: Gaussians, at: Camera, weights: list[Tensor]) -> Tensor:
    """(N, 6) dL/d(τ, ω) of each Gaussian, by definition in float64; 0 where affine splats take no part."""
    leaves = as_leaves(scene, torch.float64)
    motion = torch.zeros(len(scene), MOTION, dtype=torch.float64, requires_grad=True)
    screen = torch.zeros(len(scene), 2, dtype=torch.float64)
    definition = render_rays if scene.exact else render_reference
    truth = definition(leaves, wide(at), near=NEAR, screen=screen, motion=motion)
    loss(truth[:3], weights).backward()  # type: ignore[no-untyped-call]
    assert motion.grad is not None
    points = seen(leaves, wide(at), None).points
    polar = (points[:, 0].hypot(points[:, 2]) / points.norm(dim=1)).detach()
    return motion.grad if scene.exact else motion.grad * (polar >= MOTION_POLE)[:, None]


def loss(images: tuple[Tensor, ...], weights: list[Tensor]) -> Tensor:
    return torch.stack([(i * w.to(i.dtype)).sum() for i, w in zip(images, weights, strict=True)]).sum()


def found(scene: Gaussians, at: Camera, weights: list[Tensor]) -> Motion:
    """The same by the kernels."""
    motion = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    rendered = render(as_leaves(scene, torch.float32), at, near=NEAR, motion=motion)
    loss(rendered[:3], weights).backward()  # type: ignore[no-untyped-call]
    assert motion.grad is not None
    return Motion.of(motion.grad.numpy())


@pytest.mark.parametrize(("name", "exact"), SCENES)
@pytest.mark.parametrize("width", [64, 202])
def test_sums_agree_with_the_definition(name: str, exact: bool, width: int, instruction_set: str) -> None:
    at = camera(width)
    scene = scenes(at, exact)[name]
    with torch.no_grad():
        images = render(scene, at, near=NEAR)
    weights = random_weights(images[:3], certain(scene, at))
    expected = parts_of(scene, at, weights).numpy()
    ours = found(scene, at, weights)
    size = np.abs(expected).sum(0)
    assert (np.abs(ours.gradient - expected.sum(0)) <= 1e-3 * size).all()
    moments = expected.T @ expected
    assert np.linalg.norm(ours.moments - moments) <= 2e-3 * np.linalg.norm(moments)
    assert (ours.moments == ours.moments.T).all()


@pytest.mark.parametrize("exact", [False, True])
def test_the_definition_is_the_derivative_of_moved_cameras(exact: bool) -> None:
    """Finite differences in float64 of a render at the moved pose, which knows nothing of motions."""
    at = wide(camera())
    scene = as_leaves(replace(cloud(40), exact=exact), torch.float64)
    scene = scene.with_tensors({n: t.detach() for n, t in scene.tensors().items()}, 0)
    definition = render_rays if exact else render_reference
    screen = torch.zeros(len(scene), 2, dtype=torch.float64)
    keep = certain(replace(cloud(40), exact=exact), camera())
    weights = random_weights(definition(scene, at, near=NEAR, screen=screen)[:3], keep)
    motion = torch.zeros(len(scene), MOTION, dtype=torch.float64, requires_grad=True)
    loss(definition(scene, at, near=NEAR, screen=screen, motion=motion)[:3], weights).backward()  # type: ignore[no-untyped-call]
    assert motion.grad is not None

    def value(motion: np.ndarray) -> float:
        rotation, translation = moved(at.rotation.numpy(), at.translation.numpy(), motion)
        there = Camera(torch.from_numpy(rotation), torch.from_numpy(translation), at.width, at.height)
        return float(loss(definition(scene, there, near=NEAR, screen=screen)[:3], weights))

    step = 1e-7
    numeric = np.array([(value(step * e) - value(-step * e)) / (2 * step) for e in np.eye(MOTION)])
    assert numeric == pytest.approx(motion.grad.sum(0).numpy(), rel=1e-4, abs=1e-4 * np.abs(numeric).max())


@pytest.mark.parametrize("exact", [False, True])
def test_other_gradients_are_the_same_bytes_with_it(exact: bool) -> None:
    at, gradients = camera(202), []
    for motion in (None, torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)):
        leaves = as_leaves(replace(cloud(500), exact=exact), torch.float32)
        render(leaves, at, near=NEAR, motion=motion).color.sum().backward()  # type: ignore[no-untyped-call]
        gradients.append([leaf.grad for leaf in leaves.tensors().values()])
    for one, two in zip(*gradients, strict=True):
        assert one is not None and two is not None and torch.equal(one, two)


@pytest.mark.parametrize("count", [0, 1, 17])
def test_lanes_without_a_gaussian_add_nothing(count: int, instruction_set: str) -> None:
    """Sixteen Gaussians are computed at a time; the last one fills the lanes that are left."""
    at, scene = camera(), cloud(count)
    one = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    render(as_leaves(scene, torch.float32), at, near=NEAR, motion=one).alpha.sum().backward()  # type: ignore[no-untyped-call]
    assert one.grad is not None and (count == 0 or one.grad.any())
    weights = [torch.zeros(32, 64, 3), torch.ones(32, 64), torch.zeros(32, 64)]
    keep = certain(scene, at) if count else torch.ones(32, 64, dtype=torch.bool)
    weights[1] *= keep
    expected = parts_of(scene, at, weights).sum(0).numpy() if count else np.zeros(MOTION)
    assert found(scene, at, weights).gradient == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_a_motion_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"motion is torch\.float32"):
        render(cloud(3), camera(), motion=torch.zeros(MOTION_SUMS))


def test_motions_compose_with_poses() -> None:
    at, point = camera(), np.array([0.3, -0.2, 1.5])
    motion = np.array([0.01, -0.02, 0.03, 0, 0, np.pi / 2])
    rotation, translation = moved(at.rotation.double().numpy(), at.translation.double().numpy(), motion)
    before = at.rotation.double().numpy() @ point + at.translation.double().numpy()
    expected = np.array([-before[1], before[0], before[2]]) + motion[:3]
    assert rotation @ point + translation == pytest.approx(expected)
