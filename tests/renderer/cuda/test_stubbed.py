"""Ops on CPU tensors, run as on a card: what the other tests of the CUDA path rely on."""

import pytest
import torch

from panolog.renderer.render import render
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import no_launch, stubbed
from tests.renderer.hard_scenes import as_leaves, camera, cloud


@pytest.mark.system
def test_an_op_runs_by_the_launch_and_then_by_the_cpu_again() -> None:
    at, scene = camera(), cloud(60)
    before = render(scene, at).color
    leaves = as_leaves(scene, torch.float32)
    with stubbed(EmulatedLaunch()):
        emulated = render(leaves, at).color
        emulated.sum().backward()  # type: ignore[no-untyped-call]
    assert leaves.means.grad is not None and leaves.means.grad.isfinite().all()
    assert torch.allclose(before, emulated, atol=1e-3) and not torch.equal(before, emulated)
    assert torch.equal(before, render(scene, at).color)


def test_no_kernel_runs() -> None:
    with stubbed(no_launch):
        assert render(cloud(0), camera()).color.shape == (32, 64, 3)
