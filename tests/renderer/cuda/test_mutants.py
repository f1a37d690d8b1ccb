"""What the emulation is for: kernels broken on purpose are found, each by name."""

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from panolog.renderer import ops
from panolog.renderer.baked import Baked
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import launches, parts
from panolog.renderer.cuda.iteration import BROKEN_GRADIENT
from panolog.scene.gaussians import Gaussians, concatenate
from tests.renderer.agreement import NEAR, certain
from tests.renderer.cuda.emulation import EmulatedLaunch, KernelError
from tests.renderer.cuda.machine import (
    arguments,
    check_absolute_difference,
    check_against_cpu,
    check_motion_sums,
    check_photometric,
    check_step,
    check_tiles,
    check_weights,
    emulated,
    surrounded,
)
from tests.renderer.cuda.mutants import PATTERNS, mutants
from tests.renderer.hard_scenes import camera, cloud, directions, placed, scenes
from tests.renderer.test_adam import moving_of

pytestmark = pytest.mark.system

MUTANTS = {mutant.name: mutant for pattern in PATTERNS for mutant in mutants(pattern)}


@functools.cache
def scene(exact: bool = False) -> tuple[Gaussians, Camera, torch.Tensor]:
    """Three blocks of Gaussians, the last in part; two batches in some tiles; tiles in part both ways."""
    at = camera(52)
    spread = torch.rand(300, generator=torch.Generator().manual_seed(1))
    gaussians = placed(300, directions(spread * 0.5, spread.flip(0) * 0.4), at, -1.2)
    faint = gaussians.with_tensors(gaussians.tensors() | {"opacities": gaussians.opacities - 3})
    faint = replace(faint, exact=exact)
    return faint, at, certain(faint, at)


@functools.cache
def block(exact: bool) -> tuple[Gaussians, Baked, Camera, torch.Tensor]:
    """Some at middle distances, with others before, among and behind; half has left the active tiles.

    Own ones to the right are farther, so that what is near composites among them in some of its tiles alone.
    """
    at = camera(84)
    spread, height = torch.rand(2, 90, generator=torch.Generator().manual_seed(2))
    azimuth = torch.linspace(-2.4, 1.6, 90) + 0.4 * spread
    near = (azimuth < -0.4) == (torch.arange(90) % 4 != 1)  # own ones to the left
    away = torch.where(near, 1.0, 2.5)[:, None]
    gaussians = replace(placed(90, away * directions(azimuth, 0.4 * height), at, -1.5), exact=exact)
    own, exterior = surrounded(gaussians, at, torch.arange(20, 70, 2))
    center = -at.rotation.T @ at.translation
    means = torch.where(torch.arange(len(own))[:, None] % 2 == 0, own.means, 2 * center - own.means)
    moved = own.with_tensors(own.tensors() | {"means": means})
    return moved, exterior, at, certain(concatenate(moved, gaussians), at)


def rasterize(launch: EmulatedLaunch) -> None:
    """The image and its gradients; pairs without room; a gradient that is not finite."""
    for exact in (False, True):
        one_projection(launch, exact)
    at = camera(202)
    check_tiles(emulated(launch), scenes(at, True)["needles"], at)  # do not meet all tiles of their boxes


def one_projection(launch: EmulatedLaunch, exact: bool) -> None:
    gaussians, at, keep = scene(exact)
    check_against_cpu(emulated(launch), gaussians, at, 3, keep)
    check_against_cpu(emulated(launch), gaussians, at, 0, keep)
    own, exterior, here, sure = block(exact)
    check_against_cpu(emulated(launch), own, here, 3, sure, exterior)
    check_weights(emulated(launch), gaussians, at)
    check_weights(emulated(launch), replace(cloud(60), exact=exact), at)  # up to the rims of the image
    with launch.watching():
        parameters = {name: it.clone() for name, it in gaussians.tensors().items()}  # kernels may move them
        pose = parts.camera_struct(at.rotation, at.translation, at.width, at.height, NEAR, exact)
        angles = parts.half_pixels(at.width, at.height, gaussians.means.device) if exact else None
        projected = parts.project(launch, parameters, torch.zeros(len(gaussians), 2), pose, 3, angles)
        pairs = parts.list_pairs(launch, projected, at.width, at.height)
        parts.list_pairs(launch, projected, at.width, at.height, room=len(pairs.entries) // 2)
        sums = torch.full((len(gaussians), parts.SUMS["_ray" if exact else ""]), torch.inf)
        status = torch.zeros(1, dtype=torch.int32)
        counts = projected.tile_counts
        frame = parts.Frame(pose, 3, projected.splats, counts, sums, None)
        parts.project_step(launch, parameters, {}, 1, frame, status, broken := torch.zeros_like(status))
    assert broken.item() == BROKEN_GRADIENT * 0b111111 and status.item() == 0  # all parameters have one
    check_motion_sums(emulated(launch), 4300)
    for absolute in (False,) if exact else (False, True):
        check_step(emulated(launch), gaussians, absolute=absolute)
    parts.project_step(launch, parameters, moving_of(gaussians), 1, frame, broken, status)
    assert torch.equal(parameters["shN"], gaussians.shN)  # no step after a fault


def losses(launch: EmulatedLaunch) -> None:
    machine = emulated(launch)
    for masked, rows, exposed in ((False, False, False), (True, False, True), (False, True, True)):
        check_photometric(machine, (20, 40), masked=masked, weight=0.2, rows=rows, exposed=exposed)
    check_absolute_difference(machine, 0.5)


def iteration(launch: EmulatedLaunch) -> None:
    one, status = torch.ones((), dtype=torch.float64), torch.zeros(1, dtype=torch.int32)
    report = torch.zeros(4, dtype=torch.float64)
    launch(
        "iteration_guard",
        (1, 1),
        32,
        sums=torch.ones(3, dtype=torch.float64),
        samples=one,
        share=None,
        lambda_ssim=0.2,
        depth_sum=one,
        depth_samples=one,
        depth_share=None,
        depth_weight=0.5,
        pairs=torch.tensor([7]),
        room=9,
        status=status,
        report=report,
    )
    broken = torch.tensor([8], dtype=torch.int32)
    launch("iteration_end", (1, 1), 32, broken=broken, status=status, report=report)
    assert torch.allclose(report, torch.tensor([1.3, 1, 7, 8], dtype=torch.float64))
    assert (status.item(), broken.item()) == (8, 0)
    gradient, views, absolute = torch.zeros(3, 300)
    for fault in (0, 1):  # nothing is added after a fault
        launch(
            "iteration_statistics",
            (2, 1),
            256,
            count=300,
            screen=torch.ones(300, 2),
            absolute=2 * torch.ones(300, 2),
            state=torch.full((300,), ops.VISIBLE, dtype=torch.uint8),
            means=torch.ones(300, 3),
            camera=parts.camera_struct(torch.eye(3), torch.zeros(3), 6, 8, 0.0, False),
            angle=0,
            contribution=0,
            status=status.fill_(fault),
            gradient=gradient,
            views=views,
            absolute_sum=absolute,
        )
        assert (gradient == 5).all() and (views == 1).all()
        assert (absolute == 10).all()


EXERCISES: dict[str, Callable[[EmulatedLaunch], None]] = {
    "project": rasterize,
    "bin": rasterize,
    "composite": rasterize,
    "loss": losses,
    "iteration": iteration,
}


@pytest.mark.parametrize("exercise", dict.fromkeys(EXERCISES.values()), ids=lambda it: it.__name__)
def test_nothing_is_found_in_what_is_right(exercise: Callable[[EmulatedLaunch], None]) -> None:
    exercise(EmulatedLaunch())


def test_each_pattern_still_matches() -> None:
    found = {mutant.pattern.name for mutant in MUTANTS.values()}
    assert [pattern.name for pattern in PATTERNS if pattern.name not in found] == []


def test_the_exercises_have_what_a_fault_needs() -> None:
    for exact in (False, True):
        gaussians, at, _ = scene(exact)
        starts = launches.rasterize(EmulatedLaunch(), **arguments(gaussians, at))[-1]
        assert starts.diff().max() > parts.THREADS, "no tile has a second batch"
        own, exterior, at, sure = block(exact)
        *_, entries, starts = launches.rasterize(EmulatedLaunch(), **arguments(own, at, exterior=exterior))
        assert starts[-1] < len(entries), "all pairs are drawn"
        assert (exterior.places < 0).any() and len(exterior.splats) and sure.float().mean() > 0.5


# One mutant of each of these runs in `make test`: a kind of report each, and values of three modules.
SAMPLE = (
    "no barrier",
    "no atomic sum",
    "one too many",
    "a float less in shared memory",
    "one less in a loop",
    "lanes that leave",
    "a count without a value",
    "no front in the gradient",
    "no seam",
)
FIRST = {mutant.pattern.name: mutant.name for mutant in reversed(MUTANTS.values())}
SAMPLED = {FIRST[name] for name in SAMPLE}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name not in SAMPLED)) for name in MUTANTS]
)
def test_a_fault_is_found(name: str, tmp_path: Path) -> None:
    mutant = MUTANTS[name]
    launch = EmulatedLaunch(mutant.write(tmp_path / "csrc"), into=tmp_path, kernels=mutant.kernels)
    found = mutant.pattern.found
    with pytest.raises(KernelError if found else AssertionError, match=found or None):
        for module in mutant.modules():
            EXERCISES[module](launch)
