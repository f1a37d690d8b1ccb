"""What stands between the ops and a card: messages without one, training, streams and refusals on one."""

from dataclasses import replace

import pytest
import torch

from panolog.renderer.adam import adam_
from panolog.renderer.cuda import nvrtc
from panolog.renderer.losses import inverse_depth_loss, photometric_loss
from panolog.renderer.render import render
from panolog.scene.errors import InputError
from tests.on_device import needs_a_card
from tests.renderer.agreement import NEAR
from tests.renderer.hard_scenes import as_leaves, camera, cloud

pytest.importorskip("cuda.core", reason="CUDA: no cuda-core")
from cuda.bindings import driver

from panolog.renderer.cuda import card


def test_a_card_that_is_too_old() -> None:
    assert card.architecture("RTX 4090", (8, 9)) == "sm_89"
    with pytest.raises(InputError, match=r"Quadro P400 has compute capability 6\.1, 7\.5 is needed"):
        card.architecture("Quadro P400", (6, 1))


def test_a_driver_that_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc, "nvrtc_version", lambda: (13, 0, ("sm_89",)))
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, 13020))
    card.check_driver()
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, 12080))
    with pytest.raises(InputError, match=r"driver is of CUDA 12\.8, .* update the driver"):
        card.check_driver()


def step(scene_on: str, exact: bool) -> list[torch.Tensor]:
    """One training iteration on a device: render, loss, gradient, Adam."""
    at = camera()
    leaves = as_leaves(replace(cloud(200).to(scene_on), exact=exact), torch.float32)
    rendered = render(leaves, at.to(scene_on), near=NEAR)
    rng = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (32, 64, 3), generator=rng, dtype=torch.uint8).to(scene_on)
    mask = (torch.rand(32, 64, generator=rng) > 0.2).to(scene_on)
    depth = torch.rand(32, 64, generator=rng).to(scene_on)
    loss = photometric_loss(rendered.color, target, mask).loss
    loss = loss + inverse_depth_loss(rendered.inverse_depth, depth, mask)
    loss.backward()  # type: ignore[no-untyped-call]
    moved = []
    for leaf in leaves.tensors().values():
        assert leaf.grad is not None
        parameter = leaf.detach().clone()
        moments = torch.zeros_like(parameter), torch.zeros_like(parameter)
        adam_(parameter, leaf.grad, *moments, lr=0.01, step=1, eps=1e-4)
        moved.append(parameter.cpu())
    return moved


@needs_a_card
@pytest.mark.parametrize("exact", [False, True], ids=["affine", "exact"])
def test_a_training_step_is_that_of_the_cpu(exact: bool) -> None:
    for one, two in zip(step("cpu", exact), step("cuda", exact), strict=True):
        assert torch.allclose(one, two, atol=1e-3)


@needs_a_card
def test_kernels_follow_torchs_current_stream() -> None:
    scene, at = cloud(3000).to("cuda"), camera(512).to("cuda")
    expected = render(scene, at, near=NEAR).color
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        found = [render(scene, at, near=NEAR).color for _ in range(5)]
    stream.synchronize()
    for image in found:
        assert torch.equal(image, expected)


@needs_a_card
def test_a_tensor_that_was_left_on_the_cpu_is_refused() -> None:
    with pytest.raises(ValueError, match="sh0 is a tensor on cpu"):
        scene = cloud(20).to("cuda")
        render(replace(scene, sh0=scene.sh0.cpu()), camera())
