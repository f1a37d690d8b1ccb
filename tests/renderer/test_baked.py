"""A baked exterior: image and gradients of the whole scene, in tiles where own Gaussians can be seen."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from panolog.renderer.baked import SLACK, Baked, bake
from panolog.renderer.camera import Camera
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import Gaussians, concatenate
from tests.on_device import needs_a_card
from tests.renderer.agreement import IMAGES, NEAR, certain, random_weights
from tests.renderer.hard_scenes import as_leaves, camera, cloud, directions, hard_scenes, placed, wall
from tests.renderer.reference import rows_of

HALF = 1e-3  # rounding of a layer to float16, of values up to 1


def baked(scene: Gaussians, own: int, at: Camera) -> Baked:
    return bake(scene, own, at, near=NEAR, unit=1.0)


def first(scene: Gaussians, own: int) -> Gaussians:
    return rows_of(scene, torch.arange(own))


def active(found: Baked, at: Camera) -> Tensor:
    return found.active(at.width, at.height)


def gradients(
    scene: Gaussians, at: Camera, where: Tensor, exterior: Baked | None
) -> tuple[Render, dict[str, Tensor]]:
    """The image, and the gradients of a random function of its pixels `where`."""
    leaves = as_leaves(scene, torch.float32)
    screen = torch.zeros(len(scene), 2, requires_grad=True)
    found = render(leaves, at, near=NEAR, screen=screen, exterior=exterior)
    weights = random_weights(found[:3], where)
    torch.autograd.backward(list(found[:3]), weights)
    pairs = {**leaves.tensors(), "screen": screen}
    return found, {name: tensor.grad for name, tensor in pairs.items() if tensor.grad is not None}


@pytest.mark.parametrize("name", hard_scenes(camera()))
@pytest.mark.parametrize("exact", [False, True], ids=["affine", "exact"])
@pytest.mark.parametrize("width", [64, 202])
def test_it_looks_as_the_whole_scene(name: str, exact: bool, width: int, instruction_set: str) -> None:
    at = camera(width)
    scene = replace(hard_scenes(at)[name], exact=exact)
    own = len(scene) // 3
    exterior = baked(scene, own, at)
    where = active(exterior, at)
    assert where.any()
    whole, expected = gradients(scene, at, where, None)
    parts, found = gradients(first(scene, own), at, where, exterior)
    for image in IMAGES:
        largest = max(1.0, float(getattr(whole, image).detach().abs().max()))
        difference = (getattr(whole, image) - getattr(parts, image)).detach()[where].abs().max()
        assert float(difference) < HALF * largest, image
        assert not getattr(parts, image)[~where].any(), "an inactive tile is not empty"
    assert torch.equal(whole.visible[:own], parts.visible)
    for parameter, gradient in found.items():
        off = (gradient - expected[parameter][:own]).norm()
        assert off <= 1e-2 * expected[parameter][:own].norm() + 1e-6, parameter


def test_own_gaussians_cannot_be_seen_in_tiles_that_are_not_active() -> None:
    """Behind an opaque front there is nothing to train."""
    at = Camera(torch.eye(3), torch.zeros(3), 128, 64)
    walls = wall(at, 2.0, 1.5, 12.0)
    behind = placed(6, directions(torch.linspace(-3.1, 2.3, 6), torch.zeros(6), 20.0), at, -1.0)
    scene = concatenate(behind, walls)
    exterior = baked(scene, 6, at)
    where = active(exterior, at)
    alone = render(first(scene, 6), at, near=NEAR).alpha
    assert (alone[28:36] > 0.1).any()
    assert not where[16:48].any()
    hidden = (render(scene, at, near=NEAR).color - render(walls, at, near=NEAR).color).abs().amax(2)
    assert float(hidden[~where].max()) < 1 / 255


def test_nothing_owned_has_no_tile_and_all_owned_nothing_around_it() -> None:
    at, scene = camera(128), cloud(200)
    assert not active(baked(scene, 0, at), at).any()
    everything = baked(scene, len(scene), at)
    assert len(everything.splats) == 0
    assert not len(everything.front) and len(everything.back)


def test_what_is_hidden_is_baked_and_shows_where_it_is_uncovered() -> None:
    """Own walls before and behind frozen ones: little of these is among the own."""
    at = Camera(torch.eye(3), torch.zeros(3), 128, 64)
    near, middle, far = wall(at, 2.0, 1.5, 12.0), wall(at, 10.0, 2.0, 2.0), wall(at, 40.0, 1.0, 2.0)
    scene, own = concatenate(concatenate(near, far), middle), 144
    exterior = baked(scene, own, at)
    assert len(exterior.splats) < 16 * 72 / 4
    faded = scene.tensors()["opacities"].clone()
    faded[:72] = -12.0
    later = scene.with_tensors(scene.tensors() | {"opacities": faded})
    rows = slice(29, 35)  # of pixels
    seen = render(first(later, own), at, near=NEAR, exterior=exterior).color[rows]
    alone, whole = (render(model, at, near=NEAR).color[rows] for model in (first(later, own), later))
    assert float((seen - whole).abs().mean()) < float((alone - whole).abs().mean()) / 2


def test_what_is_owned_may_move_a_little_in_depth() -> None:
    """Within the slack of the spans it composites in the right order."""
    at = camera(128)
    scene = replace(cloud(200), exact=True)
    own = 60
    exterior = baked(scene, own, at)
    center = -at.rotation.T @ at.translation
    moved = scene.means.clone()
    moved[:own] = center + (moved[:own] - center) * (1 + 0.8 * SLACK)
    later = scene.with_tensors(scene.tensors() | {"means": moved})
    where = active(exterior, at)
    difference = (
        render(later, at, near=NEAR).color - render(first(later, own), at, near=NEAR, exterior=exterior).color
    )
    assert float(difference.abs().amax(2)[where].max()) < 2e-2
    assert float(difference.abs().amax(2)[where].mean()) < HALF


@pytest.mark.parametrize("exact", [False, True])
def test_what_moves_into_a_tile_with_far_own_gaussians_is_in_its_order(exact: bool) -> None:
    """A near lamp comes from the next tile before a frozen wall, which is nearer than what was owned here."""
    at = Camera(torch.eye(3), torch.zeros(3), 128, 64)
    pixel, equator = 2 * math.pi / 128, torch.zeros(1)
    lamp = placed(1, directions(torch.tensor([-3 * pixel]), equator, 5.0), at, -2.5)
    far = placed(1, directions(torch.tensor([8 * pixel]), equator, 20.0), at, 0.0)
    scene = replace(concatenate(concatenate(lamp, far), wall(at, 10.0, 1.0, 0.0)), exact=exact)
    exterior = baked(scene, 2, at)
    means = scene.means.clone()
    means[0] = directions(torch.tensor([3 * pixel]), equator, 5.0)[0]
    moved = scene.with_tensors(scene.tensors() | {"means": means})
    whole = render(moved, at, near=NEAR).color
    parts = render(first(moved, 2), at, near=NEAR, exterior=exterior).color
    assert float((whole - parts).abs().amax(2)[active(exterior, at)].max()) < 2 * HALF


def test_inverse_depths_of_any_unit_of_length_are_kept() -> None:
    """float16 has no values above 65,504 or below 6e-8."""
    at, scene = camera(64), cloud(150)
    for scale in (1e-6, 1e6):
        scaled = scene.with_tensors(
            scene.tensors() | {"means": scene.means * scale, "scales": scene.scales + math.log(scale)}
        )
        here = Camera(at.rotation, at.translation * scale, at.width, at.height)
        exterior = bake(scaled, 50, here, near=NEAR * scale, unit=scale)
        whole = render(scaled, here, near=NEAR * scale).inverse_depth
        parts = render(first(scaled, 50), here, near=NEAR * scale, exterior=exterior).inverse_depth
        where = active(exterior, at)
        assert float((whole - parts)[where].abs().max()) < HALF * float(whole.max())


def test_an_exterior_of_another_size_is_refused() -> None:
    scene = cloud(50)
    exterior = baked(scene, 10, camera(64))
    with pytest.raises(ValueError, match="exterior"):
        render(first(scene, 10), camera(128), near=NEAR, exterior=exterior)
    with pytest.raises(ValueError, match="exterior"):
        render(replace(first(scene, 10), exact=True), camera(64), near=NEAR, exterior=exterior)


@needs_a_card
@pytest.mark.parametrize("exact", [False, True])
def test_a_card_bakes_what_the_cpu_does(exact: bool) -> None:
    """Nothing of it is on the host."""
    scene, at, own = replace(cloud(500), exact=exact), camera(202), 150
    expected, found = baked(scene, own, at), baked(scene.to("cuda"), own, at)
    assert {tensor.device.type for tensor in found.tensors().values()} == {"cuda"}
    here = found.to("cpu")
    assert torch.equal(here.places, expected.places)
    assert torch.allclose(here.spans, expected.spans, rtol=1e-5)
    assert len(here.splats) == len(expected.splats) > 0
    theirs, ours = (render(first(scene, own), at, near=NEAR, exterior=it).color for it in (expected, here))
    assert float((ours - theirs)[certain(scene, at)].abs().max()) < HALF
