"""The CUDA kernels against those of the CPU: in the host's emulation, and on a card where there is one."""

import functools
import itertools
import math
import zlib
from dataclasses import replace

import pytest
import torch

from panolog.renderer import ops
from panolog.renderer.baked import bake
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import launches, parts
from panolog.renderer.motion import MOTION_SUMS
from panolog.scene.gaussians import Gaussians, concatenate
from tests.on_device import ON_A_CARD
from tests.renderer.agreement import NEAR, PARAMETERS, certain, check_images
from tests.renderer.cuda.emulation import EmulatedLaunch, has_fused_multiply_add
from tests.renderer.cuda.machine import (
    Machine,
    arguments,
    check_absolute_difference,
    check_against_cpu,
    check_baked,
    check_motion_sums,
    check_photometric,
    check_step,
    check_tiles,
    check_weights,
    emulated,
    results,
    surrounded,
)
from tests.renderer.cuda.ptx import PROGRAMS, emulated_ptx
from tests.renderer.cuda.waits import counted
from tests.renderer.hard_scenes import camera, cloud, directions, placed, scenes, wall

pytestmark = pytest.mark.system

NIGHTLY = pytest.mark.nightly
SCENES = [(name, exact) for exact in (False, True) for name in scenes(camera(), exact)]
NAMES = [f"{name}, exact" if exact else name for name, exact in SCENES]
both = pytest.mark.parametrize("exact", [False, True], ids=["affine", "exact"])


MACHINES = (
    "emulation",
    *(pytest.param(name, marks=NIGHTLY) for name in PROGRAMS),  # each takes a minute
    pytest.param("card", marks=ON_A_CARD),
)


@pytest.fixture(params=MACHINES)
def machine(request: pytest.FixtureRequest) -> Machine:
    if request.param == "card":
        from panolog.renderer.cuda.card import Card  # noqa: PLC0415  # needs cuda-core

        card = Card.of(torch.cuda.current_device())
        card.device.set_current()
        return Machine(card.launch, "cuda")
    seed = zlib.crc32(request.node.name.encode())
    if program := PROGRAMS.get(request.param):
        return emulated(emulated_ptx(program, seed=seed))
    return emulated(EmulatedLaunch(seed=seed))


@functools.cache
def hard(name: str, exact: bool, width: int = 64) -> tuple[Gaussians, Camera, torch.Tensor]:
    """One of `SCENES`, the camera, and `certain` of both, which takes longer than most kernels."""
    at = camera(width)
    scene = scenes(at, exact)[name]
    return scene, at, certain(scene, at)


@pytest.mark.parametrize(("name", "exact"), SCENES, ids=NAMES)
@pytest.mark.parametrize(("width", "degree"), [(64, 0), (202, 3)])
def test_hard_scenes(name: str, exact: bool, width: int, degree: int, machine: Machine) -> None:
    """At 64 pixels every splat counts as wide, at 202 most do not and the last tile is a part of one."""
    scene, at, keep = hard(name, exact, width)
    check_against_cpu(machine, scene, at, degree, keep)


@pytest.mark.parametrize(("name", "exact"), SCENES, ids=NAMES)
@pytest.mark.parametrize("rounding", ["contract", "flush"])
def test_compositing_rounds_as_a_card_may(rounding: str, name: str, exact: bool) -> None:
    """With fused multiply-adds, and without denormals: NVRTC may use both."""
    if rounding == "contract" and not has_fused_multiply_add():
        pytest.skip("this processor has no fused multiply-add")
    scene, at, keep = hard(name, exact)
    machine = emulated(EmulatedLaunch(contract=rounding == "contract", flush=rounding == "flush"))
    check_against_cpu(machine, scene, at, 3, keep)


def by_distance(scene: Gaussians, at: Camera) -> torch.Tensor:
    """Rows, nearest to the camera first."""
    from_camera = scene.means + at.rotation.T @ at.translation
    return (from_camera**2).sum(1).argsort()


OWN = {  # rows of those that train, of all rows by their distance
    "in the cell": lambda rows: rows[: len(rows) // 3],
    "in front of the cell": lambda rows: rows[len(rows) // 2 : 2 * len(rows) // 3],
    "any": lambda rows: rows.sort().values[::3],
}


@pytest.mark.parametrize(
    ("width", "own"),
    [(64, "in the cell"), (202, "in front of the cell"), pytest.param(202, "any", marks=NIGHTLY)],
)
@pytest.mark.parametrize(("name", "exact"), SCENES, ids=NAMES)
def test_an_exterior(name: str, exact: bool, width: int, own: str, machine: Machine) -> None:
    scene, at, keep = hard(name, exact, width)
    block, exterior = surrounded(scene, at, OWN[own](by_distance(scene, at)))
    check_against_cpu(machine, block, at, 3, keep, exterior)


@pytest.mark.parametrize(
    ("width", "own"),
    [
        (18, "any"),
        (64, "in the cell"),
        (202, "in front of the cell"),
        pytest.param(202, "any", marks=NIGHTLY),
    ],
)
@pytest.mark.parametrize(("name", "exact"), SCENES, ids=NAMES)
def test_what_is_baked(name: str, exact: bool, width: int, own: str, machine: Machine) -> None:
    """At 18 pixels the second of two tiles across has two columns, and both are neighbours on both sides."""
    scene, at, keep = hard(name, exact, width)
    check_baked(machine, scene, at, OWN[own](by_distance(scene, at)), keep)


@both
def test_what_is_baked_where_walls_hide_own_gaussians(exact: bool, machine: Machine) -> None:
    """In many tiles nothing behind the walls can be seen; and without own Gaussians nothing is active."""
    at = Camera(torch.eye(3), torch.zeros(3), 130, 70)
    walls = wall(at, 2.0, 0.5, 12.0)
    behind = placed(90, directions(torch.linspace(-3, 3, 90), torch.linspace(-1.3, 1.3, 90), 8.0), at, 0.5)
    scene = replace(concatenate(walls, behind), exact=exact)
    own = torch.arange(len(walls), len(scene), 2)
    around = surrounded(scene, at, own)[1]
    active = around.places >= 0
    assert active.any() and (~active & (around.spans[:, 1] > 0)).any()
    check_baked(machine, scene, at, own)
    check_baked(machine, scene, at, own[:0])
    check_baked(machine, scene, at, torch.arange(len(scene)))


@both
def test_a_view_is_baked_with_four_waits(exact: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The docstring of `bake` says what the host waits for."""
    scene, at, launch = replace(cloud(100), exact=exact), camera(), EmulatedLaunch()
    monkeypatch.setattr(ops, "bake", functools.partial(launches.bake, launch))
    with counted((at.rotation, at.translation)) as found:
        baked = bake(scene, 30, at, near=NEAR, unit=1.0)
    assert found == {"aten::_local_scalar_dense": 1, "aten::nonzero": 3}
    assert len(baked.back) and len(baked.splats)


@both
def test_weights(exact: bool, machine: Machine) -> None:
    """Some tiles have several batches of splats."""
    check_weights(machine, replace(cloud(1500), exact=exact), camera(52))


@both
def test_own_gaussians_that_have_left_the_tiles_of_an_exterior(exact: bool, machine: Machine) -> None:
    """They are not drawn there; what is frozen is drawn only among the own Gaussians of a tile."""
    at = camera(202)
    spread = torch.rand(200, generator=torch.Generator().manual_seed(3))
    scene = replace(placed(200, directions(spread, spread.flip(0) - 0.5), at, -2.0), exact=exact)
    block, exterior = surrounded(scene, at, torch.arange(80, 120))
    assert len(exterior.splats) > 0
    away = at.rotation.T @ torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ at.rotation
    center = -at.rotation.T @ at.translation
    moved = block.with_tensors(block.tensors() | {"means": (block.means - center) @ away + center})
    active = exterior.active(at.width, at.height)
    outside = certain(moved, at) & ~active
    everywhere = certain(concatenate(moved, scene), at)
    check_against_cpu(machine, moved, at, 3, everywhere, exterior)
    color, *_, met, entries, starts = machine.run(
        launches.rasterize, **arguments(moved, at, exterior=exterior)
    )
    assert outside.any() and not color[~active].any()
    assert int(starts[-1]) < len(entries) == int(met.sum())
    if exact:
        check_tiles(machine, moved, at, exterior)


@both
def test_an_exterior_of_another_camera_is_refused(exact: bool, machine: Machine) -> None:
    at, scene = camera(64), replace(cloud(30), exact=exact)
    block, exterior = surrounded(scene, at, torch.arange(10))
    for other, here in ((block, camera(128)), (replace(block, exact=not exact), at)):
        with pytest.raises(ValueError, match="the exterior is not one of this camera"):
            machine.run(launches.rasterize, **arguments(other, here, exterior=exterior))


@both
@pytest.mark.parametrize("width", [2, 18, 50])
def test_any_width(width: int, exact: bool, machine: Machine) -> None:
    at, scene = camera(width), replace(cloud(60), exact=exact)
    keep = certain(scene, at)
    assert keep.float().mean() > 0.9
    check_against_cpu(machine, scene, at, 2, keep)


@both
def test_many_batches_in_many_tiles(exact: bool, machine: Machine) -> None:
    at, scene = camera(96), replace(cloud(1500), exact=exact)
    check_against_cpu(machine, scene, at, 1, certain(scene, at))


@both
def test_int16_counts_the_tiles_of_4096_by_2048_pixels(
    exact: bool, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are 2¹⁵."""
    at, scene = camera(4096), cloud(20).to(machine.device)
    view = parts.camera_struct(at.rotation, at.translation, at.width, at.height, NEAR, exact)
    screen = torch.zeros(len(scene), 2, device=machine.device)
    angles = parts.half_pixels(at.width, at.height, screen.device) if exact else None
    projected = parts.project(machine.launch, scene.tensors(), screen, view, 3, angles)
    kernels = []

    def launch(kernel: str, grid: tuple[int, int], block: int, /, **given: parts.Argument) -> None:
        kernels.append(kernel)
        machine.launch(kernel, grid, block, **given)

    narrow = parts.list_pairs(launch, projected, at.width, at.height)
    monkeypatch.setattr(parts, "NARROW_TILES", 0)
    wide = parts.list_pairs(launch, projected, at.width, at.height)
    assert kernels == (["bin_ray_narrow", "bin_ray_wide"] if exact else ["bin_narrow", "bin_wide"])
    assert all(torch.equal(one, two) for one, two in zip(narrow, wide, strict=True))
    assert narrow.starts[-1] == len(narrow.entries) > 0


@both
@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(count: int, exact: bool, machine: Machine) -> None:
    check_baked(machine, replace(cloud(count), exact=exact), camera(), torch.arange(count))
    given = arguments(replace(cloud(count), exact=exact), camera())
    ours = machine.run(launches.rasterize, **given)
    check_images(ours, ops.rasterize(**given), torch.ones(32, 64, dtype=torch.bool))
    weights = [torch.ones_like(image) for image in ours[:3]]
    *found, motion = machine.run(launches.rasterize_backward, **given, **results(ours, weights), moving=True)
    assert motion.shape == (MOTION_SUMS,) and bool(motion.any()) == (count > 0)
    assert [gradient.shape for gradient in found] == [given[name].shape for name in PARAMETERS]


@both
def test_tiles_list_what_meets_them_nearest_first(exact: bool, machine: Machine) -> None:
    scene, at = replace(cloud(300), exact=exact), camera(128)
    *_, splats, _, met, entries, starts = machine.run(launches.rasterize, **arguments(scene, at))
    distance = splats.view(-1, 16)[:, 10]
    assert starts[0] == 0 and starts[-1] == len(entries) == met.sum()
    assert torch.equal(torch.bincount(entries, minlength=300), met.to(torch.int64))
    for begin, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        assert (distance[entries[begin:end]].diff() >= 0).all()


@pytest.mark.parametrize("width", [64, 202])
@pytest.mark.parametrize("name", scenes(camera(), True))
def test_rays_meet_the_tiles_that_they_meet_on_the_cpu(name: str, width: int, machine: Machine) -> None:
    at = camera(width)
    check_tiles(machine, scenes(at, True)[name], at)


@pytest.mark.parametrize(("exact", "value"), [(False, math.nan), (True, math.inf)])
@pytest.mark.parametrize("parameter", ["means", "quats", "scales", "opacities", "sh0", "shN"])
def test_a_broken_gaussian_harms_no_other(
    parameter: str, value: float, exact: bool, machine: Machine
) -> None:
    scene, at = replace(cloud(50), exact=exact), camera()
    broken = scene.tensors()[parameter].clone()
    broken[7].fill_(value)
    damaged = scene.with_tensors(scene.tensors() | {parameter: broken})
    given = arguments(damaged, at)
    others = machine.run(launches.rasterize, **arguments(scene.select(torch.arange(50) != 7), at))
    ours = machine.run(launches.rasterize, **given)
    assert torch.equal(ours[0], others[0])
    assert (ours[3] == ops.INVALID).nonzero().flatten().tolist() == [7]
    weights = [torch.ones_like(image) for image in ours[:3]]
    for gradient in machine.run(launches.rasterize_backward, **given, **results(ours, weights))[:-1]:
        assert gradient.isfinite().all() and not gradient[7].any()


@pytest.mark.parametrize("count", [1, 127, 128, 4096, 4097, 9000])
def test_sums_of_motion(count: int, machine: Machine) -> None:
    check_motion_sums(machine, count)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(24, 48), (32, 64), (5, 10), (3, 6)])
def test_photometric_loss(size: tuple[int, int], masked: bool, machine: Machine) -> None:
    check = functools.partial(check_photometric, machine, size, masked=masked)
    for weight in (0.0, 1.0):
        check(weight=weight, rows=False, exposed=False)
    for rows, exposed in itertools.product((False, True), repeat=2):
        check(weight=0.2, rows=rows, exposed=exposed)


def test_nothing_under_a_mask_that_covers_all(machine: Machine) -> None:
    color, target = torch.rand(16, 32, 3), torch.zeros(16, 32, 3, dtype=torch.uint8)
    nothing = torch.zeros(16, 32, dtype=torch.bool)
    given = {"color": color, "target": target, "mask": nothing, "lambda_ssim": 0.2}
    values, gradient, _ = machine.run(launches.photometric, **given)
    assert torch.equal(values, ops.photometric(**given)[0])
    assert not gradient.any()


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_absolute_difference(share: float, machine: Machine) -> None:
    check_absolute_difference(machine, share)


@pytest.mark.parametrize("kind", ["affine", "absolute", "exact", "among an exterior"])
def test_a_step_is_that_of_the_gradients_of_autograd(kind: str, machine: Machine) -> None:
    """The model has three blocks of Gaussians, of which a part moves."""
    scene, at = replace(cloud(300), exact=kind not in ("affine", "absolute")), camera()
    if kind == "among an exterior":
        check_step(machine, *surrounded(scene, at, torch.arange(0, 300, 2)))
    else:
        check_step(machine, scene, absolute=kind == "absolute")
