"""What stands between the ops and a card: messages without one, the renderer's own tests on one."""

import math
from dataclasses import replace

import pytest
import torch

from panolog.renderer import ops
from panolog.renderer.adam import adam_
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import nvrtc
from panolog.renderer.losses import inverse_depth_loss, photometric_loss
from panolog.renderer.render import Render, render
from panolog.scene.errors import InputError
from tests.renderer.agreement import NEAR
from tests.renderer.hard_scenes import as_leaves, camera, cloud, decided, hard_scenes, wide
from tests.renderer.reference import render_reference

pytest.importorskip("cuda.core", reason="needs cuda-core: pip install cuda-core")
from cuda.bindings import driver

from panolog.renderer.cuda import card

needs_a_card = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA card")


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


@needs_a_card
@pytest.mark.cuda
@pytest.mark.parametrize("name", list(hard_scenes(camera())))
def test_renders_as_the_reference_does(name: str) -> None:
    at = camera()
    scene = hard_scenes(at)[name]
    keep = decided(scene, at, NEAR)
    exact, fast = as_leaves(scene, torch.float64), as_leaves(scene.to("cuda"), torch.float32)
    screens = [torch.zeros(len(scene), 2, dtype=t.means.dtype, device=t.means.device) for t in (exact, fast)]
    for screen in screens:
        screen.requires_grad_()
    truth = render_reference(exact, wide(at), near=NEAR, screen=screens[0])
    ours = render(fast, at.to("cuda"), near=NEAR, screen=screens[1])
    assert float((truth.color - ours.color.cpu())[keep].abs().max()) < 1e-4 * max(
        1.0, float(truth.color.max())
    )
    for rendered in (truth, ours):
        (rendered.color * keep[..., None].to(rendered.color.device)).square().sum().backward()  # type: ignore[no-untyped-call]
    pairs = zip((*exact.tensors().values(), screens[0]), (*fast.tensors().values(), screens[1]), strict=True)
    for one, two in pairs:
        assert one.grad is not None and two.grad is not None
        assert (one.grad - two.grad.cpu()).norm() <= 1e-3 * one.grad.norm()


@needs_a_card
@pytest.mark.cuda
def test_an_eighth_turn_about_the_vertical_shifts_the_image_by_an_eighth() -> None:
    at = Camera(torch.eye(3), torch.tensor([0.1, -0.2, 0.05]), 128, 64)
    c = math.sqrt(0.5)
    turn = torch.tensor([[c, 0.0, c], [0.0, 1.0, 0.0], [-c, 0.0, c]])
    turned = Camera(turn @ at.rotation, turn @ at.translation, 128, 64)
    scene = cloud(150)
    keep = decided(scene, at, NEAR).roll(16, 1)
    before, after = (
        render(scene.to("cuda"), view.to("cuda"), near=NEAR).color.cpu() for view in (at, turned)
    )
    assert float((before.roll(16, 1) - after)[keep].abs().max()) < 1e-4


def step(scene_on: str, exact: bool) -> tuple[Render, list[torch.Tensor]]:
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
    return rendered, moved


@needs_a_card
@pytest.mark.cuda
@pytest.mark.parametrize("exact", [False, True], ids=["affine", "exact"])
def test_a_training_step_is_that_of_the_cpu(exact: bool) -> None:
    (_, here), (_, there) = step("cpu", exact), step("cuda", exact)
    for one, two in zip(here, there, strict=True):
        assert torch.allclose(one, two, atol=1e-3)


@needs_a_card
@pytest.mark.cuda
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
@pytest.mark.cuda
def test_the_custom_ops_keep_torchs_rules() -> None:
    scene, at = as_leaves(cloud(20).to("cuda"), torch.float32), camera().to("cuda")
    screen = torch.zeros(20, 2, device="cuda")
    given = (*scene.tensors().values(), screen, at.rotation, at.translation, 64, 32, 3, NEAR, False, [])
    torch.library.opcheck(
        torch.ops.panolog.rasterize, given, test_utils=("test_schema", "test_autograd_registration")
    )
    assert ops.rasterize(*given)[0].is_cuda


@needs_a_card
@pytest.mark.cuda
def test_a_tensor_that_was_left_on_the_cpu_is_refused() -> None:
    with pytest.raises(ValueError, match="sh0 is a tensor on cpu"):
        scene = cloud(20).to("cuda")
        render(replace(scene, sh0=scene.sh0.cpu()), camera())
