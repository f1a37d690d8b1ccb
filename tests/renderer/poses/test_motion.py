"""How the loss changes as the camera moves: the definition against finite differences.

tests/renderer/test_rasterizer.py has the kernels against the definition.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panolog.renderer.camera import Camera
from panolog.renderer.motion import MOTION, MOTION_SUMS, moved
from panolog.renderer.render import render
from tests.renderer.agreement import NEAR, truth_of
from tests.renderer.hard_scenes import as_leaves, camera, cloud, wide
from tests.renderer.reference import render_reference
from tests.renderer.reference_rays import render_rays


@pytest.mark.parametrize("exact", [False, True])
def test_the_definition_is_the_derivative_of_moved_cameras(exact: bool) -> None:
    """Finite differences in float64 of a render at the moved pose, which knows nothing of motions."""
    at, scene = camera(), replace(cloud(40), exact=exact)
    truth, precise = truth_of(scene, at, 3), as_leaves(scene, torch.float64)
    definition = render_rays if exact else render_reference
    rotation, translation = wide(at).rotation.numpy(), wide(at).translation.numpy()

    def value(motion: np.ndarray) -> float:
        turned, shifted = map(torch.from_numpy, moved(rotation, translation, motion))
        there = Camera(turned, shifted, at.width, at.height)
        with torch.no_grad():
            screen = torch.zeros(len(scene), 2, dtype=torch.float64)
            images = definition(precise, there, near=NEAR, screen=screen)[:3]
        return sum(float((image * w).sum()) for image, w in zip(images, truth.weights, strict=True))

    step = 1e-7
    numeric = np.array([(value(step * e) - value(-step * e)) / (2 * step) for e in np.eye(MOTION)])
    slack = 1e-4 * np.abs(numeric).max()
    assert slack > 0 and numeric == pytest.approx(truth.motions.sum(0), rel=1e-4, abs=slack)


@pytest.mark.parametrize("exact", [False, True])
def test_other_gradients_are_the_same_bytes_with_it(exact: bool) -> None:
    at, gradients = camera(202), []
    for motion in (None, torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)):
        leaves = as_leaves(replace(cloud(500), exact=exact), torch.float32)
        render(leaves, at, near=NEAR, motion=motion).color.sum().backward()  # type: ignore[no-untyped-call]
        gradients.append([leaf.grad for leaf in leaves.tensors().values()])
    for one, two in zip(*gradients, strict=True):
        assert one is not None and two is not None and one.any() and torch.equal(one, two)
