"""Schedules: 3DGS's own at 30,000 iterations, scaled with floors below that."""

import math
from typing import Any

import pytest

from panolog.orchestrator.runs.config import RunConfig
from panolog.scene.random_streams import generator
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.schedule import Schedule, epoch


def schedule(iterations: int, *, refine: bool = False, **groups: Any) -> Schedule:
    return Schedule(TrainConfig.model_validate(groups), iterations, extent=2.0, refine=refine)


def test_a_full_run_is_that_of_3dgs() -> None:
    full = schedule(30_000)
    densified = [i for i in range(1, 30_001) if full.densifies(i)]
    assert densified == list(range(600, 15_000, 100))
    assert [i for i in range(1, 30_001) if full.resets(i)] == [3000, 6000, 9000, 12_000]
    assert [full.prunes_large(i) for i in (3000, 3100)] == [False, True]
    assert not schedule(30_000, densify={"prune_scale": 0}).prunes_large(3100)
    assert [full.sh_degree(i) for i in (999, 1000, 2000, 3000, 30_000)] == [0, 1, 2, 3, 3]


@pytest.mark.parametrize("iterations", [1, 600, 601, 1_500, 30_000])
def test_whether_opacities_are_ever_reset(iterations: int) -> None:
    run = schedule(iterations)
    assert run.drops_unrisen == any(run.resets(i) for i in range(1, iterations + 1))


@pytest.mark.parametrize("iterations", [1, 10, 300, 1000, 7000])
@pytest.mark.parametrize("recovery", [0, 100])
def test_gaussians_change_in_number_at_no_other_turn(iterations: int, recovery: int) -> None:
    run = schedule(iterations, reset={"recovery": recovery, "every": 700}, densify={"until": 30_000})
    changes = [i for i in range(1, iterations + 1) if run.densifies(i) or run.resets(i)]
    assert set(changes) <= set(run.turns())


def test_intervals_of_a_short_run_have_floors() -> None:
    short = schedule(1_500)
    assert [i for i in range(1, 1_501) if short.densifies(i)] == list(range(50, 750, 25))
    assert [i for i in range(1, 1_501) if short.resets(i)] == [300, 600]
    assert short.sh_degree(50) == 1
    assert schedule(1_500, refine=True).sh_degree(1) == 3  # Stage II uses all harmonics at once


def test_opacities_recover_from_a_reset_before_the_next_pruning() -> None:
    calm = {"recovery": 100}
    short = schedule(1_500, reset=calm)
    assert [i for i in range(1, 1_501) if short.resets(i)] == [300, 600]
    ends = [*range(50, 301, 25), *range(400, 601, 25), 700, 725]
    assert [i for i in range(1, 1_501) if short.densifies(i)] == ends
    full, usual = schedule(30_000, reset=calm), schedule(30_000)
    assert all(full.densifies(i) == usual.densifies(i) for i in range(1, 30_001))


@pytest.mark.parametrize("iterations", [1, 10, 300, 1000, 7000])
def test_no_reset_near_the_end(iterations: int) -> None:
    always = schedule(iterations, densify={"until": 30_000}, reset={"every_floor": 1})
    assert not any(always.resets(i) for i in range(1, iterations + 1) if i > 0.7 * iterations)


def test_depth_weight_decays_exponentially() -> None:
    run = schedule(1_000)
    assert run.depth_weight(0) == 0.5
    assert run.depth_weight(500) == pytest.approx((0.5 * 0.01) ** 0.5)
    assert run.depth_weight(1_000) == pytest.approx(0.01)
    assert schedule(1_000, depth={"w0": 0}).depth_weight(500) == 0


def test_position_rate_decays_in_scene_extents() -> None:
    run = schedule(1_000)
    assert run.rates(0)["means"] == pytest.approx(2 * 1.6e-4)
    assert run.rates(500)["means"] == pytest.approx(2 * 1.6e-5)
    assert run.rates(1_000)["means"] == pytest.approx(2 * 1.6e-6)
    assert run.rates(1)["opacities"] == run.rates(1_000)["opacities"] == 0.05
    apart = schedule(1_000, optimizer={"unit": "distance"})
    assert apart.rates(500) == run.rates(500) | {"means": pytest.approx(1.6e-5)}


def test_a_block_may_continue_at_the_rates_at_which_stage_one_ended() -> None:
    stage2 = {"position": 0.01, "rate": 0.5}
    coarse, block = schedule(1_500, stage2=stage2), schedule(1_500, refine=True, stage2=stage2)
    assert coarse.rates(7) == schedule(1_500).rates(7)
    for iteration in (1, 700):
        assert block.rates(iteration)["means"] == pytest.approx(coarse.rates(1_500)["means"], rel=1e-9)
    others = ("quats", "scales", "opacities", "sh0", "shN")
    assert all(block.rates(7)[name] == coarse.rates(7)[name] / 2 for name in others)
    assert schedule(1_500, refine=True).rates(7) == coarse.rates(7)


def test_the_sky_has_bounds_where_its_scales_train() -> None:
    sky = {"count": 100, "pixels": 8, "size": 2.0, "sharp": True}
    groups: dict[str, Any] = {"sky": sky, "optimizer": {"unit": "distance", "largest": 0.5}}
    most = 2 * math.sqrt(4 * math.pi / 64)  # of 32 x 16 pixels
    assert schedule(1_500, **groups).sizes(32) == pytest.approx((0.0, 0.5, most))
    assert schedule(1_500, refine=True, **groups).sizes(32) == (0.0, 0.5, 0.0)
    for plain in ({**sky, "sharp": False}, {**sky, "count": 0}):
        assert schedule(1_500, **{**groups, "sky": plain}).sizes(32) == (0.0, 0.5, 0.0)


def test_the_authors_refine_at_rates_of_their_own() -> None:
    """Of positions and scales; what is not raised at the end stays."""
    config = RunConfig(recipe="authors")
    coarse, block = (Schedule(config, 30_000, 1.0, refine) for refine in (False, True))
    assert (coarse.rates(0)["means"], block.rates(0)["means"]) == pytest.approx((1.6e-4, 6.4e-5))
    assert block.rates(1) | {"means": 0} == coarse.rates(1) | {"means": 0, "scales": pytest.approx(2e-3)}
    assert coarse.resets(3000) and not coarse.drops_unrisen
    assert coarse.depth_weight(1) == 0


def test_a_block_may_have_a_budget_and_a_decay_of_its_own() -> None:
    densify = {"method": "relocate", "growth": 0.5, "opacity_decay": 0.004}
    stage2 = {"growth": 3.0, "opacity_decay": 0.25}
    coarse = schedule(1_500, densify=densify, stage2=stage2)
    block = schedule(1_500, refine=True, densify=densify, stage2=stage2)
    assert coarse.densify == coarse.config.densify
    assert block.densify.opacity_decay == 0.001
    added = [run.budget(1_500, 1_000, 32_768) - 1_000 for run in (coarse, block)]
    assert added[1] == pytest.approx(3 * added[0], abs=2)
    plain = schedule(1_500, refine=True, densify=densify)
    assert plain.densify == coarse.densify and plain.budget(900, 1_000, 32_768) == coarse.budget(
        900, 1_000, 32_768
    )


@pytest.mark.parametrize("iterations", [500, 30_000])
def test_noise_cools_from_one_with_the_rate_of_positions(iterations: int) -> None:
    run = schedule(iterations, optimizer={"short_runs": 0.5})
    assert [run.cooling(at) for at in (0, iterations)] == pytest.approx([1, 0.01])
    assert schedule(iterations, refine=True, stage2={"position": 0.3}).cooling(0) == pytest.approx(0.3)


def test_the_rate_of_opacities_decays_to_its_last_one() -> None:
    optimizer = {"opacity": 0.04, "opacity_final": 0.01}
    runs = (
        schedule(200, optimizer=optimizer),
        schedule(200, optimizer=optimizer, refine=True, stage2={"rate": 0.5}),
    )
    for run, part in zip(runs, (1.0, 0.5), strict=True):
        assert [run.rates(at)["opacities"] for at in (0, 100, 200)] == pytest.approx(
            [0.04 * part, 0.02 * part, 0.01 * part]
        )
    for iterations, last in ((30_000, 0.01), (15_000, 0.02), (3_000, 0.04)):
        short = schedule(iterations, optimizer=optimizer | {"short_runs": 0.5})
        assert short.rates(iterations)["opacities"] == pytest.approx(last)
    assert {schedule(200).rates(at)["opacities"] for at in (0, 200)} == {0.05}


def test_a_short_run_has_larger_rates_where_they_follow_its_length() -> None:
    usual, hasty = (schedule(300, optimizer={"short_runs": p}).rates(100) for p in (0, 0.5))
    ratios = {name: hasty[name] / usual[name] for name in usual}
    assert ratios == pytest.approx(
        {"means": 100, "quats": 10, "scales": 10, "opacities": 1, "sh0": 10**0.5, "shN": 10**0.5}
    )
    for iterations in (30_000, 60_000):
        full, same = (schedule(iterations, optimizer={"short_runs": p}).rates(100) for p in (0, 0.5))
        assert full == same


def test_every_epoch_is_another_permutation() -> None:
    views = tuple(range(100, 120))
    orders = [epoch(3, "coarse", views, number) for number in range(3)]
    assert all(sorted(order) == list(views) for order in orders)
    assert len(set(orders)) == 3
    assert orders[0] != epoch(3, "block/000", views, 0) != epoch(4, "block/000", views, 0)


def test_random_numbers_depend_on_all_arguments() -> None:
    first = generator(1, "coarse", "split", 25).standard_normal()
    assert first == generator(1, "coarse", "split", 25).standard_normal()
    others = [(2, "coarse", "split", 25), (1, "block/000", "split", 25), (1, "coarse", "split", 50)]
    assert all(generator(*other).standard_normal() != first for other in others)
