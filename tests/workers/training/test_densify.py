"""Densification: who clones, splits and goes, and that moments, statistics and the sky follow."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from panolog.renderer import ops
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import iteration
from panolog.renderer.cuda.iteration import Found, Problem, Status
from panolog.renderer.render import render
from panolog.scene.gaussians import logit
from panolog.workers.training.config import DensifyConfig
from panolog.workers.training.densify import (
    Statistics,
    densify,
    drop_large,
    rate_units,
    reset_opacities,
)
from panolog.workers.training.initialise import isotropic
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.schedule import FULL_RUN, Schedule
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.hard_scenes import as_leaves
from tests.workers.trainings import settings

ALL = torch.ones(0, dtype=torch.bool)  # of the sky
EXTENT = 10.0  # so that scales above 0.1 split
QUIET, LOUD = 1.9e-4, 1.0  # screen gradients, below and above `densify.gradient`


def state_of(scales: list[float], opacities: list[float], sky: int, moments: float = 7.0) -> ModelState:
    """Gaussians identified by their x; all moments have one value."""
    means = np.arange(len(scales))[:, None] * np.array([100.0, 0, 0])
    colors = np.random.default_rng(0).uniform(0.5, 0.8, means.shape)
    gaussians = isotropic(means, np.array(scales), colors, 0.5)
    gaussians.opacities[:] = torch.tensor([logit(opacity) for opacity in opacities])
    state = ModelState.start(replace(gaussians, sky=sky))
    for moment in (*state.exp_avg.values(), *state.exp_avg_sq.values()):
        moment.fill_(moments)
    return state


def statistics_of(gradients: list[float]) -> Statistics:
    return Statistics(torch.tensor(gradients), torch.ones(len(gradients)), DensifyConfig())


def densified(gradients: list[float], *, cap: int = 0) -> tuple[ModelState, list[int]]:
    """Six Gaussians, the last two sky: after densification, and which row each came from."""
    state = state_of([0.05, 0.05, 0.5, 0.05, 50.0, 50.0], [0.5, 0.5, 0.5, 0.001, 0.001, 0.5], sky=2)
    random = np.random.default_rng(0)
    densify(state, statistics_of(gradients), DensifyConfig(max_gaussians=cap), EXTENT, random)
    return state, [round(x / 100) for x in state.gaussians.means[:, 0].tolist()]


def test_small_ones_clone_large_ones_split_transparent_ones_go_and_sky_stays() -> None:
    state, origin = densified([QUIET, LOUD, LOUD, LOUD])
    assert origin == [0, 1, 1, 2, 2, 4, 5]
    assert state.gaussians.sky == 2
    sizes = state.gaussians.scales[:, 0].exp()
    assert sizes.tolist() == pytest.approx([0.05, 0.05, 0.05, 0.5 / 1.6, 0.5 / 1.6, 50, 50])
    assert torch.equal(state.gaussians.means[1], state.gaussians.means[2])
    assert not torch.equal(state.gaussians.means[3], state.gaussians.means[4])


def test_large_ones_may_split_by_absolute_gradients() -> None:
    """And small ones clone by their usual ones; none of them where it is faint."""
    config = DensifyConfig(split_gradient=4e-4, least_opacity=0.15)
    state = state_of([0.05, 0.05, 0.5, 0.5, 0.5, 0.05], [0.5, 0.5, 0.5, 0.5, 0.14, 0.14], sky=0)
    usual = torch.tensor([LOUD, QUIET, LOUD, QUIET, LOUD, LOUD])
    absolute = torch.tensor([QUIET, LOUD, QUIET, 5e-4, LOUD, LOUD])
    statistics = Statistics(usual, torch.ones(6), config, absolute)
    densify(state, statistics, config, EXTENT, np.random.default_rng(0))
    sizes = state.gaussians.scales[:, 0].exp().tolist()
    assert sizes == pytest.approx([0.05, 0.05, 0.5, 0.5, 0.05, 0.05, 0.5 / 1.6, 0.5 / 1.6])
    assert state.gaussians.means[[0, 5], 0].tolist() == [0, 0]  # the clone


def schedule_of(iterations: int = FULL_RUN, **groups: Any) -> Schedule:
    return Schedule(settings(**groups), iterations, EXTENT, refine=False)


def test_a_step_may_be_a_part_of_the_distance() -> None:
    """From the nearest camera; what is divided keeps it."""
    state = state_of([0.05, 0.05, 0.5], [0.5, 0.5, 0.5], sky=0, moments=0)  # at x = 0, 100 and 200
    centers, given = np.array([[1.0, 0, 0], [210, 0, 0]]), schedule_of(optimizer={"unit": "distance"})
    state.units = rate_units(state.gaussians.means, centers, given, 5.0, ALL)
    assert {name: units.tolist() for name, units in state.units.items()} == {"means": [1, 99, 10]}
    saved = {name: tensor.clone() for name, tensor in state.tensors().items()}
    state = ModelState.from_tensors(saved)
    saved["units.means"] = saved["units.means"][:, None].repeat(1, 3)  # as checkpoints once had them
    assert torch.equal(ModelState.from_tensors(saved).units["means"], state.units["means"])
    moving = state.moving({"means": 0.01}, {"means": 2})["means"]
    assert (moving.lr, moving.values, moving.units) == (0.01, 2 * 3, state.units["means"])
    densify(state, statistics_of([LOUD] * 3), DensifyConfig(), EXTENT, np.random.default_rng(0))
    assert sorted(state.units["means"].tolist()) == [1, 1, 10, 10, 99, 99]


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ((0.01, 0.0, 0.0), [0.05, 8.0, 0.1, 8.0, 0.5, 8.0]),
        ((0.0, 0.5, 0.0), [0.05, 2.0, 0.05, 5.0, 0.5, 8.0]),
        ((0.01, 0.5, 0.0), [0.05, 2.0, 0.1, 5.0, 0.5, 8.0]),
        ((0.0, 0.0, 0.6), [0.05, 8.0, 0.05, 8.0, 4.2, 6.0]),
        ((0.06, 0.5, 0.1), [0.24, 2.0, 0.6, 5.0, 0.7, 1.0]),
        ((0.0, 0.0, 2.0), [0.05, 8.0, 0.05, 8.0, 14.0, 14.0]),
    ],
)
def test_axes_are_bounded_by_the_distance_from_the_nearest_camera(
    bounds: tuple[float, float, float], expected: list[float]
) -> None:
    state = state_of([0.05, 0.05, 0.5], [0.5, 0.5, 0.5], sky=1, moments=0)
    state.units["means"] = torch.tensor([4.0, 10.0, 10.0])
    state.gaussians.scales[:, 1] = math.log(8.0)
    state.bound(*bounds)
    assert state.gaussians.scales[:, :2].exp().flatten().tolist() == pytest.approx(expected)


def test_sky_that_nothing_shows_does_not_learn() -> None:
    state = state_of([0.05, 0.05, 0.5, 0.5], [0.5] * 4, sky=2, moments=0)
    given = np.array([[1.0, 0, 0]]), schedule_of(sh={"near": 4}), 5.0
    units = rate_units(state.gaussians.means, *given, torch.tensor([True, False]))
    assert [units[name].tolist() for name in ("quats", "scales", "opacities", "sh0")] == [[1, 1, 1, 0]] * 4
    assert units["shN"].tolist() == pytest.approx([0.05, 1, 1, 0])
    assert [*rate_units(state.gaussians.means, *given, torch.tensor([True, True]))] == ["shN"]


def test_what_is_near_may_be_slow_to_depend_on_the_direction() -> None:
    state = state_of([0.05, 0.05, 0.5], [0.5, 0.5, 0.5], sky=0, moments=0)  # at x = 0, 100 and 200
    centers, full = np.array([[1.0, 0, 0], [210, 0, 0]]), schedule_of(sh={"near": 4})
    state.units = rate_units(state.gaussians.means, centers, full, 5.0, ALL)
    assert state.units["shN"].tolist() == pytest.approx([0.05, 1, 0.5])
    assert rate_units(state.gaussians.means, centers, full, 0.0, ALL) == {}
    short = schedule_of(15_000, sh={"near": 4}, optimizer={"short_runs": 0.5})  # half as far in an iteration
    assert rate_units(state.gaussians.means, centers, short, 5.0, ALL)["shN"].tolist() == pytest.approx(
        [0.1, 1, 1]
    )
    names = state.gaussians.tensors()
    moving = state.moving(dict.fromkeys(names, 0.01), dict.fromkeys(names, 3))
    assert [name for name, it in moving.items() if it.units is not None] == ["shN"]


def test_moments_follow_and_new_ones_start_at_zero() -> None:
    state, _ = densified([QUIET, LOUD, LOUD, QUIET])
    for moments in (state.exp_avg, state.exp_avg_sq):
        for name, moment in moments.items():
            assert moment.shape == state.gaussians.tensors()[name].shape
            first = moment.reshape(len(moment), -1)[:, 0]
            assert first.tolist() == [7, 7, 0, 0, 0, 7, 7]


@pytest.mark.parametrize(
    ("cap", "expected"), [(3, [0, 1, 2, 4, 5]), (4, [0, 1, 2, 2, 4, 5]), (9, [0, 1, 0, 1, 2, 2, 4, 5])]
)
def test_under_a_cap_the_largest_gradients_go_first(cap: int, expected: list[int]) -> None:
    _, origin = densified([0.2, 0.3, 0.9, 1.0], cap=cap)
    assert origin == expected


def test_halves_are_drawn_from_the_gaussian_that_they_were() -> None:
    count = 4000
    state = state_of([0.5] * count, [0.5] * count, sky=0)
    state.gaussians.means.zero_()
    state.gaussians.scales[:] = torch.tensor([1.0, 0.5, 0.25]).log()
    state.gaussians.quats[:] = torch.tensor([math.sqrt(2), 0, 0, math.sqrt(2)])  # a quarter turn about z
    densify(state, statistics_of([LOUD] * count), DensifyConfig(), EXTENT, np.random.default_rng(0))
    assert len(state.gaussians) == 2 * count
    assert torch.allclose(state.gaussians.means.std(0), torch.tensor([0.5, 1.0, 0.25]), rtol=0.05)


def test_statistics_are_means_over_the_views_that_saw_it() -> None:
    statistics = Statistics.zeros(3, "cpu", DensifyConfig())
    gradient = torch.tensor([[3e-3, 0], [3e-3, 8e-3], [1, 1], [1, 1]])
    at = torch.ones(4, 3), Camera(torch.eye(3), torch.zeros(3), 2000, 1000)
    statistics.add(gradient, torch.tensor([True, True, False, True]), *at)
    statistics.add(torch.zeros(4, 2), torch.tensor([False, True, False, True]), *at)
    assert statistics.mean().tolist() == pytest.approx([3, 2.5, 0])


def measured(latitude: float, shift: tuple[float, float, float], measure: str) -> float:
    """The screen gradient of a Gaussian that is a little off, at a latitude in degrees."""
    state = state_of([0.3], [0.6], sky=0)
    state.gaussians.means[0] = torch.tensor([0, 0, 3.0])
    model = as_leaves(state.gaussians, torch.float32)
    c, s = math.cos(math.radians(latitude)), math.sin(math.radians(latitude))
    turn = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]])
    camera = Camera(turn, torch.zeros(3), 1024, 512)
    with torch.no_grad():
        moved = replace(state.gaussians, means=state.gaussians.means + torch.tensor(shift))
        target = render(moved, camera).color
    screen = torch.zeros(1, 2, requires_grad=True)
    seen = render(model, camera, screen=screen)
    (seen.color - target).abs().mean().backward()  # type: ignore[no-untyped-call]
    config = DensifyConfig.model_validate({"measure": measure})
    statistics = Statistics.zeros(1, "cpu", config)
    assert screen.grad is not None
    statistics.add(screen.grad, seen.visible, state.gaussians.means, camera)
    return float(statistics.mean())


@pytest.mark.parametrize("shift", [(0.1, 0, 0), (0, 0.1, 0)])
def test_an_angle_is_the_same_wherever_on_the_sphere(shift: tuple[float, float, float]) -> None:
    """The camera turns about its x axis, so that the Gaussian moves toward a pole; half images grow there."""
    at_equator = measured(0, shift, "angle")
    for latitude in (30, -60, 70):
        assert measured(latitude, shift, "angle") == pytest.approx(at_equator, rel=0.15)
    if shift[1]:
        assert measured(70, shift, "image") > 2 * measured(0, shift, "image")


def test_views_weigh_as_they_see_it() -> None:
    """Views from a distance count less, and those that see nothing of it do not count."""
    config = DensifyConfig(views="contribution")
    statistics = Statistics.zeros(1, "cpu", config)
    for distance, gradient in ((1.0, 1.0), (2.0, 5.0), (1.0, 0.0)):
        camera = Camera(torch.eye(3), torch.tensor([0, 0, distance]), 2, 2)
        arguments = torch.tensor([[gradient, 0]]), torch.tensor([True])
        statistics.add(*arguments, torch.zeros(1, 3), camera)
    assert statistics.mean().tolist() == pytest.approx([(1 + 5 / 4) / (1 + 1 / 4)])


@pytest.mark.parametrize("measure", ["image", "angle"])
@pytest.mark.parametrize("views", ["all", "contribution"])
@pytest.mark.parametrize("more", [False, True])
def test_a_card_measures_the_same(measure: str, views: str, more: bool) -> None:
    """With `more` also absolute gradients."""
    random = np.random.default_rng(0)
    count = 300
    means, screen = (torch.from_numpy(random.normal(size=(count, k)).astype(np.float32)) for k in (3, 4))
    screen[::5] = 0
    state = torch.from_numpy(random.integers(0, 3, count).astype(np.uint8))
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    camera = Camera.of(turn, random.normal(size=3), 64, 32)
    needed = {"split_gradient": 1.0} if more else {}
    config = DensifyConfig.model_validate({"measure": measure, "views": views, **needed})
    ours, theirs = Statistics.zeros(count - 20, "cpu", config), Statistics.zeros(count - 20, "cpu", config)
    theirs.add(screen[:, : 4 if more else 2], state == ops.VISIBLE, means, camera)
    zero = torch.zeros(0)
    layers: dict[str, Any] = {"image": zero, "mask": None, "depth": None, "rows": None}
    unused = layers | dict.fromkeys(("depth_weight", "lambda_ssim", "sh_degree", "near"), 0)
    kinds = screen[:, :2].contiguous(), screen[:, 2:].contiguous() if more else None
    found = Found(*kinds, state, zero, zero, zero, None)
    problem = Problem(model={"means": means}, camera=camera, **unused)
    given = EmulatedLaunch(), found, Status(torch.device("cpu")), problem, ours.gradient, ours.views
    iteration.add_statistics(
        *given,
        absolute=ours.absolute,
        angle=measure == "angle",
        contribution=views == "contribution",
    )
    assert theirs.tensors().keys() == ours.tensors().keys() and len(ours.tensors()) == (3 if more else 2)
    for name, expected in theirs.tensors().items():
        assert float(expected.sum()) > 0
        assert torch.allclose(ours.tensors()[name], expected, rtol=1e-4), name


def test_halves_along_the_longest_axis_keep_the_mass() -> None:
    state = state_of([0.5, 0.05], [0.5, 0.5], sky=0)
    state.gaussians.scales[0] = torch.tensor([0.1, 0.8, 0.2]).log()
    config = DensifyConfig(long_axis=True)
    densify(state, statistics_of([LOUD, LOUD]), config, EXTENT, np.random.default_rng(0))
    assert len(state.gaussians) == 4  # the small one is cloned
    halves = (
        state.gaussians.means[2:],
        state.gaussians.scales[2:].exp(),
        state.gaussians.opacities[2:].sigmoid(),
    )
    assert halves[0][:, 1].tolist() == pytest.approx([-0.8 / math.sqrt(2), 0.8 / math.sqrt(2)])
    assert torch.allclose(halves[1], torch.tensor([0.1, 0.8 / math.sqrt(2), 0.2]))
    assert halves[2].tolist() == pytest.approx([0.5 / math.sqrt(2)] * 2)


def test_large_ones_go_but_for_the_sky() -> None:
    state = state_of([0.9, 1.1, 0.5, 50.0], [0.5] * 4, sky=1)
    state.gaussians.scales[2, 1] = math.log(1.2)
    drop_large(state, 1.0)
    assert state.gaussians.means[:, 0].tolist() == [0, 300]
    assert state.gaussians.sky == 1 and len(state.exp_avg["means"]) == 2


def test_reset_spares_the_sky() -> None:
    state = state_of([0.1] * 4, [0.5, 0.008, 0.9, 0.9], sky=1)
    reset_opacities(state, 0.01)
    assert state.gaussians.opacities.sigmoid().tolist() == pytest.approx([0.01, 0.008, 0.01, 0.9])
    assert state.exp_avg["opacities"].tolist() == state.exp_avg_sq["opacities"].tolist() == [0, 0, 0, 7]
    assert (state.exp_avg["means"] == 7).all()


def test_broken_gaussians_are_counted_and_removed() -> None:
    state = state_of([0.1] * 6, [0.5] * 6, sky=2)
    state.gaussians.means[1, 2] = math.nan
    state.gaussians.opacities[2] = math.inf
    state.gaussians.quats[3] = 0
    state.gaussians.shN[5, 7, 1] = math.nan
    assert state.drop_invalid() == 4
    assert state.gaussians.means[:, 0].tolist() == [0, 400]
    assert state.gaussians.sky == 1 and len(state.exp_avg["shN"]) == 2
    assert state.drop_invalid() == 0
