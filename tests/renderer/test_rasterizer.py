"""The kernels against the definitions, on every instruction set that this processor has."""

import functools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from panolog.renderer import _core, ops
from panolog.renderer.camera import Camera
from panolog.renderer.motion import MOTION_SUMS
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians
from tests.on_device import needs_a_card, on_all_devices
from tests.renderer.agreement import NEAR, Truth, check_definition, random_weights, truth_of
from tests.renderer.cuda.machine import arguments
from tests.renderer.hard_scenes import as_leaves, camera, cloud, directions, placed, scenes, wide
from tests.renderer.reference import render_reference, rows_of

SCENES = [(name, exact) for exact in (False, True) for name in scenes(camera(), exact)]
both = pytest.mark.parametrize("exact", [False, True], ids=["affine", "exact"])


@functools.cache
def truth(name: str, exact: bool, width: int, degree: int) -> Truth:
    """Of one of `SCENES`, for all instruction sets."""
    at = camera(width)
    return truth_of(scenes(at, exact)[name], at, degree)


@pytest.mark.parametrize(("name", "exact"), SCENES)
@pytest.mark.parametrize(("width", "degree"), [(64, 0), (130, 3)])
def test_values_and_gradients_agree_with_the_definition(
    name: str, exact: bool, width: int, degree: int, instruction_set: str
) -> None:
    """At 130 pixels the last tile is a part of one, and a box may have more than `kPlacesAtOnce` tiles."""
    at = camera(width)
    check_definition(scenes(at, exact)[name], at, degree, truth=truth(name, exact, width, degree))


@on_all_devices
@both
@pytest.mark.parametrize(("width", "degree"), [(2, 2), (18, 1), (50, 2), (202, 1)])
def test_any_width_and_degree_agree_with_the_definition(
    width: int, degree: int, exact: bool, device: str
) -> None:
    check_definition(replace(cloud(60), exact=exact), camera(width), degree, device)


def screen_gradient(scene: Gaussians, at: Camera, weight: Tensor, columns: int) -> Tensor:
    """(N, columns) what `screen` receives, from the gradient (H, W, 3) of the colours."""
    screen = torch.zeros(len(scene), columns, requires_grad=True)
    made = render(as_leaves(scene, torch.float32), at, near=NEAR, screen=screen)
    made.color.backward(weight)  # type: ignore[no-untyped-call]
    assert screen.grad is not None
    return screen.grad


@pytest.mark.parametrize("name", ["cloud", "crowded", "seam", "poles"])
def test_absolute_gradients_are_sums_over_single_pixels(name: str, instruction_set: str) -> None:
    at = camera(16)
    scene = scenes(at, False)[name]
    weight = torch.randn(at.height, at.width, 3, generator=torch.Generator().manual_seed(0))
    found, total = screen_gradient(scene, at, weight, 4), torch.zeros(len(scene), 2)
    assert torch.equal(found[:, :2], screen_gradient(scene, at, weight, 2))
    for pixel in range(at.height * at.width):
        one = torch.zeros_like(weight).view(-1, 3)
        one[pixel] = weight.view(-1, 3)[pixel]
        total += screen_gradient(scene, at, one.view_as(weight), 2).abs()
    assert torch.allclose(found[:, 2:], total, rtol=1e-4, atol=1e-5)
    assert float(total.sum()) > 1.1 * float(found[:, :2].abs().sum())  # signs cancel


@needs_a_card
@pytest.mark.parametrize(("name", "exact"), SCENES)
def test_a_card_agrees_with_the_definition(name: str, exact: bool) -> None:
    at = camera()
    check_definition(scenes(at, exact)[name], at, 3, "cuda")


@both
@pytest.mark.parametrize("count", [1, 17])
def test_lanes_without_a_gaussian_add_nothing(count: int, exact: bool, instruction_set: str) -> None:
    """Sixteen Gaussians are computed at a time; the last one fills the lanes that are left."""
    check_definition(replace(cloud(count), exact=exact), camera(), 3)


@both
def test_no_gaussian(exact: bool, instruction_set: str) -> None:
    assert _core.instruction_set() == instruction_set
    motion = torch.ones(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    rendered = render(as_leaves(replace(cloud(0), exact=exact), torch.float32), camera(), motion=motion)
    assert rendered.color.shape == (32, 64, 3) and not rendered.color.any() and len(rendered.visible) == 0
    rendered.alpha.sum().backward()  # type: ignore[no-untyped-call]
    assert motion.grad is not None and not motion.grad.any()


@pytest.mark.parametrize(("name", "exact"), SCENES)
def test_the_order_of_rows_changes_no_byte_of_an_image(name: str, exact: bool, instruction_set: str) -> None:
    """Sixteen rows are projected, and their tiles found, at a time: whichever they are."""
    at = camera(202)
    scene = scenes(at, exact)[name]
    distances = (scene.means @ at.rotation.T + at.translation).norm(dim=1)
    rows = distances.sort().indices[distances.sort().values.diff(prepend=torch.tensor([-1.0])) > 1e-4]
    expected = render(rows_of(scene, rows), at, near=NEAR)
    for seed in range(2):
        other = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))]
        found = render(rows_of(scene, other), at, near=NEAR)
        assert torch.equal(found.color, expected.color) and torch.equal(found.alpha, expected.alpha)


@pytest.mark.parametrize("tilt", [0.2, 0.6, 1.2])
def test_a_needle_across_the_image_is_as_exact_as_a_ball(tilt: float) -> None:
    at = Camera(torch.eye(3), torch.zeros(3), 1024, 512)
    half = tilt / 2
    needle = Gaussians(
        means=torch.tensor([[0.1, 0.05, 3.0]]),
        quats=torch.tensor([[math.cos(half), 0.0, 0.0, math.sin(half)]]),
        scales=torch.tensor([[5.0, 0.003, 0.003]]).log(),
        opacities=torch.tensor([2.0]),
        sh0=torch.full((1, 1, 3), 0.5),
        shN=torch.zeros(1, 15, 3),
    )
    assert render(needle, at, near=NEAR).alpha.max() > 0.8
    check_definition(needle, at, 3)


def test_a_gaussian_overhead_is_a_cap_not_a_sliver() -> None:
    at = Camera(torch.eye(3), torch.zeros(3), 256, 128)

    def covered(offset: float) -> float:
        overhead = placed(1, torch.tensor([[offset, -2.0, 0.0]]), at, -2.5)
        return render(overhead, at).alpha.sum().item()

    assert covered(0.0) == pytest.approx(covered(1e-3), rel=0.2)
    assert covered(1e-6) == pytest.approx(covered(1e-3), rel=0.2)


def test_the_gradient_stays_finite_where_a_gaussian_meets_the_camera() -> None:
    at = Camera(torch.eye(3), torch.zeros(3), 64, 32)
    for point in ([0.0, -1e-6, 0.0], [1e-6, 0.0, 0.0], [0.0, -2.0, 0.0]):
        scene = as_leaves(placed(1, torch.tensor([point]), at, -2.0), torch.float32)
        render(scene, at).color.sum().backward()  # type: ignore[no-untyped-call]
        for name, leaf in scene.tensors().items():
            assert leaf.grad is not None and leaf.grad.isfinite().all(), (point, name)


def test_colours_beyond_all_floats_and_shifts_that_are_none_are_reported() -> None:
    scene, at = cloud(5), camera()
    huge = scene.shN.clone()
    huge[2] = 3e38 * torch.sign(huge[2])
    rendered = render(scene.with_tensors(scene.tensors() | {"shN": huge}), at)
    assert rendered.invalid[2] and rendered.color.isfinite().all()
    rendered = render(scene, at, screen=torch.full((5, 2), math.nan))
    assert rendered.invalid.all() and not rendered.color.any()


@both
def test_gradients_of_many_are_those_of_the_few_that_are_seen(exact: bool, instruction_set: str) -> None:
    few = replace(cloud(40), exact=exact)
    count = (1 << 18) + 5  # kStreamed in csrc/spans.cpp, and a rest of a vector
    unseen = cloud(1)
    unseen.opacities.fill_(-20.0)
    source = torch.full((count,), 40)
    seen = torch.cat([torch.arange(20), torch.arange(count - 20, count)])
    source[seen] = torch.arange(40)
    tensors = {n: torch.cat([t, getattr(unseen, n)])[source] for n, t in few.tensors().items()}
    found = []
    for scene in (few, few.with_tensors(tensors)):
        leaves = as_leaves(scene, torch.float32)
        screen = torch.zeros(len(scene), 2, requires_grad=True)
        rendered = render(leaves, camera(), near=NEAR, screen=screen)
        torch.autograd.backward(list(rendered[:3]), random_weights(rendered[:3], torch.ones(32, 64) > 0))
        found.append({name: tensor.grad for name, tensor in {**leaves.tensors(), "screen": screen}.items()})
    rest = torch.ones(count, dtype=torch.bool)
    rest[seen] = False
    for name, expected in found[0].items():
        gradient = found[1][name]
        assert gradient is not None and expected is not None
        assert expected.any()
        assert torch.equal(gradient[seen], expected), name
        assert not gradient[rest].any(), name


PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN")
BROKEN = [(name, value) for name in PARAMETERS for value in (math.nan, math.inf)]


@both
@pytest.mark.parametrize(("parameter", "value"), [*BROKEN, ("quats", 0.0)])
def test_a_broken_gaussian_is_reported_and_harms_no_other(parameter: str, value: float, exact: bool) -> None:
    scene, at = replace(cloud(50), exact=exact), camera()
    broken = scene.tensors()[parameter].clone()
    broken[7].fill_(value)
    damaged = as_leaves(scene.with_tensors(scene.tensors() | {parameter: broken}), torch.float32)
    others = scene.select(torch.arange(50) != 7)
    rendered = render(damaged, at, near=NEAR)
    assert torch.equal(rendered.color, render(others, at, near=NEAR).color)
    assert rendered.invalid.nonzero().flatten().tolist() == [7]
    rendered.color.sum().backward()  # type: ignore[no-untyped-call]
    for name, leaf in damaged.tensors().items():
        assert leaf.grad is not None and leaf.grad.isfinite().all(), name
        assert not leaf.grad[7].any(), name


def test_an_exact_gaussian_that_reaches_a_pole_is_tested_in_few_rows() -> None:
    at, count = camera(256), 400
    rng = torch.Generator().manual_seed(3)
    below, sign = (
        0.01 * torch.rand(count, generator=rng),
        torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0),
    )
    where = directions(torch.rand(count, generator=rng) * 6.28, sign * (math.pi / 2 - below))
    scene = replace(placed(count, where, at, -4.5), exact=True)
    splats = ops.rasterize(**arguments(scene, at))[4].view(-1, 16)
    rows, columns = splats[:, 12], splats[:, 15]  # half of each: SplatOf in csrc/formulas.h
    around = columns >= at.width
    assert around.sum() > count / 4
    assert float(rows[around].max()) < at.height / 8


@pytest.mark.system
def test_the_reference_differentiates_itself_correctly() -> None:
    at = wide(camera(8))
    scene = as_leaves(cloud(4, 5), torch.float64)
    assert render_reference(scene, at, near=NEAR).visible.all()

    def images(*tensors: Tensor) -> tuple[Tensor, ...]:
        return render_reference(Gaussians(*tensors), at, near=NEAR)[:3]  # type: ignore[arg-type]

    inputs = tuple(scene.tensors().values())
    assert torch.autograd.gradcheck(images, inputs, eps=1e-7, atol=1e-4, fast_mode=True)


@pytest.mark.parametrize(
    "change",
    [
        {"sh_degree": 4},
        {"screen": torch.zeros(3, 3)},
        {"screen": torch.zeros(3, 4), "gaussians": replace(cloud(3), exact=True)},
        {"motion": torch.zeros(MOTION_SUMS)},
        {"camera": Camera(torch.eye(4), torch.zeros(3), 64, 32)},
        {"camera": Camera(torch.eye(3), torch.zeros(3, dtype=torch.float64), 64, 32)},
        {"camera": Camera(torch.eye(3), torch.zeros(3), 0, 0)},
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be"):
        render(**{"gaussians": cloud(3), "camera": camera(), **change})


def test_parameters_of_different_lengths_do_not_reach_the_kernels() -> None:
    scene, at = cloud(5), camera()
    pose = at.rotation, at.translation
    tensors = {**scene.tensors(), "opacities": torch.zeros(9)}.values()
    with pytest.raises(ValueError, match=r"do not fit|equally many"):
        torch.ops.panolog.rasterize(*tensors, torch.zeros(5, 2), *pose, 64, 32, 3, 0.0, False, [])
    wrong = [tensor.double() for tensor in scene.tensors().values()]
    with pytest.raises(TypeError, match="float64"):
        torch.ops.panolog.rasterize(*wrong, torch.zeros(5, 2), *pose, 64, 32, 3, 0.0, False, [])


@pytest.mark.system  # loads much of torch's own tests
@on_all_devices
def test_the_custom_ops_keep_torchs_rules(device: str) -> None:
    scene, at = as_leaves(cloud(20).to(device), torch.float32), camera().to(device)
    screen = torch.zeros(20, 2, device=device)
    given = (*scene.tensors().values(), screen, at.rotation, at.translation, 64, 32, 3, NEAR, False, [])
    utilities = ("test_schema", "test_autograd_registration")
    torch.library.opcheck(torch.ops.panolog.rasterize, given, test_utils=utilities)
    assert render(scene, at, near=NEAR).color.device.type == device
