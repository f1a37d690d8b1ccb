"""Growth to a budget: how many there are, what the picture keeps, who takes part; a resume is exact."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.gaussians import Gaussians, logit
from panolog.workers.growth_law import population
from panolog.workers.training.config import DensifyConfig, TrainConfig
from panolog.workers.training.densify import Statistics
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.relocate import MOST, Room, relocate, shares
from panolog.workers.training.schedule import Schedule
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed
from tests.workers.small import WIDTH, small_scene
from tests.workers.trainings import RELOCATED, coarse_of, settings, threads, trained

STILL = DensifyConfig(method="relocate", opacity_decay=0, noise=0)  # only what keeps the picture


def random_state(count: int, sky: int = 3, faint: float = 0.2) -> ModelState:
    """Gaussians around the origin, some of them transparent, the last ones sky."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(count, 3))
    directions *= 3 / np.linalg.norm(directions, axis=1, keepdims=True)
    opacities = np.where(rng.random(count) < faint, 0.001, rng.uniform(0.1, 0.8, count))
    tensors = {
        "means": directions,
        "quats": rng.normal(size=(count, 4)),
        "scales": np.log(rng.uniform(0.05, 0.4, (count, 3))),
        "opacities": np.log(opacities / (1 - opacities)),
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": 0.1 * rng.normal(size=(count, 15, 3)),
    }
    narrow = {n: torch.from_numpy(a.astype(np.float32)) for n, a in tensors.items()}
    return ModelState.start(Gaussians(**narrow, sky=sky, exact=False))


def quiet(state: ModelState) -> Statistics:
    return Statistics.zeros(state.gaussians.scene.stop, "cpu", DensifyConfig())


def everywhere(state: ModelState, target: int) -> Room:
    return Room(target, np.ones(state.gaussians.scene.stop, np.bool_), 1.0)


def picture(gaussians: Gaussians) -> torch.Tensor:
    with torch.no_grad():
        return render(gaussians, Camera(torch.eye(3), torch.zeros(3), 128, 64)).color


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(float(((a - b) ** 2).mean()))


@pytest.mark.parametrize(("weight", "long_axis"), [("opacity", False), ("gradient", True)])
@pytest.mark.parametrize("target", [0, 79, 80, 81, 97, 160, 500])
def test_there_are_as_many_as_the_budget_says(target: int, weight: str, long_axis: bool) -> None:
    state, statistics = random_state(103), Statistics(torch.rand(100), torch.ones(100), DensifyConfig())
    sky = {name: tensor[100:].clone() for name, tensor in state.gaussians.tensors().items()}
    live = int((state.gaussians.opacities[:100] >= logit(0.005)).sum())
    config = DensifyConfig.model_validate({"method": "relocate", "weight": weight, "long_axis": long_axis})
    relocate(state, statistics, config, everywhere(state, target), np.random.default_rng(1))
    assert state.gaussians.scene.stop == max(target, live) and state.gaussians.sky == 3
    for name, tensor in state.gaussians.tensors().items():
        assert torch.equal(tensor[-3:], sky[name]) and torch.isfinite(tensor).all()
        assert len(state.exp_avg[name]) == len(state.exp_avg_sq[name]) == len(tensor)


def test_nothing_is_copied_where_nothing_lives() -> None:
    state = random_state(20, sky=0, faint=1.1)
    relocate(state, quiet(state), STILL, everywhere(state, 50), np.random.default_rng(1))
    assert len(state.gaussians) == 0


def test_nothing_is_copied_more_often_than_shares_are_known_for() -> None:
    state = random_state(1, sky=0, faint=0)
    relocate(state, quiet(state), STILL, everywhere(state, 500), np.random.default_rng(1))
    assert len(state.gaussians) == MOST


def test_copies_are_drawn_in_proportion_and_start_without_moments() -> None:
    state = random_state(3, sky=0, faint=0)
    for moments in (state.exp_avg, state.exp_avg_sq):
        for moment in moments.values():
            moment.fill_(7)
    config = STILL.model_copy(update={"weight": "gradient"})
    statistics = Statistics(torch.tensor([3.0, 0, 1.0]), torch.ones(3), config)
    first = state.gaussians.sh0.clone()
    relocate(state, statistics, config, everywhere(state, 11), np.random.default_rng(1))
    origin = [int((first == row).all(-1).flatten().nonzero()[0, 0]) for row in state.gaussians.sh0]
    assert origin == [0, 1, 2, *[0] * 6, *[2] * 2]
    assert state.exp_avg["opacities"].tolist() == [7] * 3 + [0] * 8


def test_relocation_keeps_the_picture() -> None:
    """A third more copies: without their shares of opacity and size, or with dead ones kept, it changes."""
    state = random_state(303)
    before = picture(state.gaussians)
    naive = ModelState.start(state.gaussians)
    relocate(state, quiet(state), STILL, everywhere(state, 400), np.random.default_rng(1))
    assert len(state.gaussians) == 403
    naive.rearrange(torch.arange(303).repeat(2)[:403], torch.zeros(403, dtype=torch.bool), 0)
    assert psnr(picture(state.gaussians), before) > 36
    assert psnr(picture(state.gaussians), before) > psnr(picture(naive.gaussians), before) + 10


@pytest.mark.parametrize("parts", [1, 2, 3, 10, MOST])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_shares_have_the_integral_of_the_whole(parts: int, opacity: float) -> None:
    """Numerically, of alpha along a line through the middle, where n copies lie over each other."""
    each, factor = shares(np.array([opacity]), np.array([parts]))
    x = np.linspace(-60, 60, 400_001)
    alpha = 1 - (1 - each[0] * np.exp(-0.5 * (x / factor[0]) ** 2)) ** parts
    assert 1 - (1 - each[0]) ** parts == pytest.approx(opacity)
    assert alpha.sum() * (x[1] - x[0]) == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-4)


@pytest.mark.parametrize("parts", [2, 3, 5])
def test_parts_along_the_longest_axis_keep_mass_and_variance(parts: int) -> None:
    state = random_state(1, sky=0, faint=0)
    state.gaussians.scales[:] = torch.tensor([[0.1, 0.9, 0.3]]).log()
    state.gaussians.quats[:] = torch.tensor([math.sqrt(2), 0, 0, math.sqrt(2)])  # the longest axis is -x
    whole, opacity = state.gaussians.means.clone(), float(state.gaussians.opacities.sigmoid())
    config = STILL.model_copy(update={"long_axis": True})
    relocate(state, quiet(state), config, everywhere(state, parts), np.random.default_rng(1))
    offsets = state.gaussians.means - whole
    size = state.gaussians.scales.exp()
    assert offsets[:, 1:].abs().max() < 1e-5
    assert float(offsets[:, 0].mean()) == pytest.approx(0, abs=1e-5)
    assert float((offsets[:, 0] ** 2).mean() + size[0, 1] ** 2) == pytest.approx(0.81, rel=1e-4)
    assert torch.allclose(size[:, [0, 2]], torch.tensor([0.1, 0.3]))
    mass = state.gaussians.opacities.sigmoid() * size[:, 1]
    assert float(mass.sum()) == pytest.approx(0.9 * opacity, rel=1e-4)


def test_what_is_outside_of_the_cell_stays_as_it_is() -> None:
    """All but what is transparent: the block sees it, but does not own it."""
    state = random_state(203)
    inside = (state.gaussians.means[:200, 0] > 0).numpy()
    opaque = (state.gaussians.opacities[:200] >= logit(0.005)).numpy()
    outside = {n: t[:200][~inside & opaque] for n, t in state.gaussians.tensors().items()}
    config = DensifyConfig(method="relocate", opacity_decay=0.01, noise=1)
    room = Room(2 * int(inside.sum()), inside, 1.0)
    relocate(state, quiet(state), config, room, np.random.default_rng(1))
    after = state.gaussians.means[state.gaussians.scene, 0] <= 0
    for name, tensor in outside.items():
        assert torch.equal(state.gaussians.tensors()[name][state.gaussians.scene][after], tensor), name
    assert int((~after).sum()) == room.target


def test_noise_moves_the_faint_within_their_own_shape() -> None:
    state = random_state(2000, sky=0, faint=0)
    faint = torch.arange(2000) % 2 == 0
    state.gaussians.opacities[faint] = logit(0.0051)
    state.gaussians.scales[:] = torch.tensor([0.4, 0.2, 1e-3]).log()
    state.gaussians.quats[:] = torch.tensor([1.0, 0, 0, 0])
    before = state.gaussians.means.clone()
    config = STILL.model_copy(update={"noise": 0.5})
    relocate(state, quiet(state), config, everywhere(state, 0), np.random.default_rng(1))
    moved = state.gaussians.means - before
    assert not moved[~faint].any()
    expected = 0.5 * 0.5 * torch.tensor([0.4, 0.1, 2.5e-6])  # at o = t half of it is left
    assert torch.allclose(moved[faint].std(0), expected, rtol=0.1)


def test_threads_do_not_matter() -> None:
    found = []
    config = DensifyConfig(method="relocate", weight="gradient", long_axis=True)
    for count in (1, 3):
        state, generator = random_state(40_003), torch.Generator().manual_seed(1)
        statistics = Statistics(torch.rand(40_000, generator=generator), torch.ones(40_000), config)
        with threads(count):
            relocate(state, statistics, config, everywhere(state, 70_000), np.random.default_rng(1))
        found.append([t.numpy().tobytes() for t in state.tensors().values()])
    assert found[0] == found[1]


def test_the_budget_rises_evenly_and_ends_where_preflight_says() -> None:
    config = TrainConfig(densify=DensifyConfig(method="relocate", growth=1.0))
    schedule = Schedule(config, 1500, extent=1.0, refine=False)
    counts = [schedule.budget(i, 1000, 32_768) for i in range(1, 1501)]
    full = 1000 + int(1000 * (0.85 + 0.5 * math.log(32.768)))
    assert counts == sorted(counts) and counts[0] == 1000 and counts[-1] == full
    assert counts.index(full) + 1 == pytest.approx(25 + 0.5 * 725, abs=1)  # from 500 to 15,000 of 30,000
    assert population(1000, 50.0, 32_768, schedule)[-1][1] == full
    assert not any(schedule.resets(i) for i in range(1, 1501))
    capped = replace(
        schedule, config=TrainConfig(densify=config.densify.model_copy(update={"max_gaussians": 1200}))
    )
    assert capped.budget(1500, 1000, 32_768) == 1200 and capped.budget(1500, 1300, 32_768) == 1300


@pytest.mark.parametrize(
    ("iterations", "refine", "factor"),
    [(500, False, 1), (1_500, False, 1), (6_000, False, 2), (90_000, False, 20**0.5), (30_000, True, 1)],
)
def test_the_budget_follows_the_length_of_a_long_stage_one(
    iterations: int, refine: bool, factor: float
) -> None:
    """A block begins with what a long Stage I has grown."""
    config = TrainConfig(densify=DensifyConfig(method="relocate", growth=1.0, long_runs=0.5))
    schedule = Schedule(config, iterations, extent=1.0, refine=refine)
    added = 1000 * (0.85 + 0.5 * math.log(32.768))
    assert schedule.budget(iterations, 1000, 32_768) == 1000 + int(factor * added)


def test_training_ends_with_the_budget(tmp_path: Path) -> None:
    config = settings(sky={"count": 20}, densify=RELOCATED)
    coarse = coarse_of(small_scene(tmp_path, points=60), config)
    schedule = Schedule(config, 24, extent=1.0, refine=False)
    assert len(trained(coarse)) == schedule.budget(24, 60, WIDTH * WIDTH // 2) + 20 > 100
    with stubbed(EmulatedLaunch()):
        on_card = trained(replace(coarse, width=WIDTH // 2, iterations=9))
    schedule = replace(schedule, iterations=9)
    assert len(on_card) == schedule.budget(9, 60, WIDTH * WIDTH // 8) + 20 > 80
