"""The average of the last models of a task, in place of the last one."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch

from panolog.partition.bounds import aabb
from panolog.partition.cells import Cell, Grid
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint, Event, Trained
from panolog.workers.specs import Value
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.optimizer import Average
from panolog.workers.training.schedule import AVERAGED, Schedule
from panolog.workers.training.trainer import TrainSpec, train
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed
from tests.workers.small import WIDTH, small_scene

ITERATIONS = 24


def config(average: float, **settings: Any) -> TrainConfig:
    given = {
        "sky": {"count": 60},
        "densify": {"every_floor": 4, "start": 0, "gradient": 1e-6, "max_gaussians": 260},
        "reset": {"every_floor": 9, "opacity": 0.05},
        "optimizer": {"average": average},
        "checkpoint": {"every": 1, "share": 1},
        **settings,
    }
    return TrainConfig.model_validate(given)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return small_scene(tmp_path_factory.mktemp("scene"))


def coarse(scene: Scene, chosen: TrainConfig) -> TrainSpec:
    return TrainSpec(
        task=COARSE,
        scene=Value(scene),
        views=scene.train,
        width=WIDTH,
        iterations=ITERATIONS,
        config=chosen,
        seed=3,
    )


def trained(events: list[Event]) -> Gaussians:
    last = events[-1]
    assert isinstance(last, Trained)
    return last.gaussians


def models(events: list[Event]) -> list[dict[str, torch.Tensor]]:
    """After each iteration but the last."""
    found = [event for event in events if isinstance(event, Checkpoint)]
    return [{name: event.tensors[name] for name in ("means", "shN", "opacities")} for event in found]


@pytest.mark.parametrize("iterations", [10, 24, 500, 30_000])
@pytest.mark.parametrize("average", [0.05, 0.125, 1 - 1e-9])
def test_some_models_count_the_last_among_them(iterations: int, average: float) -> None:
    schedule = Schedule(config(average), iterations, 1.0, refine=False)
    counted = [it for it in range(1, iterations + 1) if schedule.averages(it)]
    assert counted[-1] == iterations and counted[0] > iterations * (1 - average)
    assert 1 <= len(counted) <= 2 * AVERAGED
    assert len(counted) >= min(AVERAGED, int(iterations * average))
    assert len({b - a for a, b in pairwise(counted)}) <= 1


def test_none_counts_in_a_run_without_an_average() -> None:
    schedule = Schedule(config(0.0), ITERATIONS, 1.0, refine=False)
    assert not any(schedule.averages(iteration) for iteration in range(1, ITERATIONS + 1))


def test_the_model_is_the_mean_of_the_last_ones(scene: Scene) -> None:
    calm = {"reset": {"quiet": 1.0}}
    events = list(train(coarse(scene, config(0.25, **calm))))
    last, found = (
        trained(list(train(coarse(scene, config(0.0, **calm))))).tensors(),
        trained(events).tensors(),
    )
    states = [*models(events), last][-6:]
    for name in ("means", "shN", "opacities"):
        expected = torch.stack([state[name].double() for state in states]).mean(0)
        assert torch.allclose(found[name].double(), expected, rtol=1e-6, atol=1e-7)
        assert not torch.equal(found[name], last[name])


def test_a_resume_within_the_average_ends_in_the_same_bytes(scene: Scene) -> None:
    spec = coarse(scene, config(0.25))
    events = list(train(spec))
    whole = trained(events).tensors()
    for event in [event for event in events if isinstance(event, Checkpoint)][-4:]:
        before = {name: tensor.clone() for name, tensor in event.tensors.items()}
        again = trained(list(train(replace(spec, checkpoint=Value(event))))).tensors()
        assert all(torch.equal(again[name], whole[name]) for name in whole)
        assert all(torch.equal(event.tensors[name], tensor) for name, tensor in before.items())


def test_only_models_with_the_same_rows_count(scene: Scene) -> None:
    """Densification goes on until 20 of 24 iterations, resets until 18."""
    settings = {"densify": {"every_floor": 4, "start": 0, "until": 26_000, "gradient": 1e-6}}
    long = trained(list(train(coarse(scene, config(0.99, **settings)))))
    short = trained(list(train(coarse(scene, config(4 / ITERATIONS, **settings)))))
    assert all(map(torch.equal, long.tensors().values(), short.tensors().values()))


def test_the_sky_stays_where_it_is(scene: Scene) -> None:
    averaged, last = (trained(list(train(coarse(scene, config(part))))) for part in (0.25, 0.0))
    assert averaged.sky == last.sky == 60
    assert torch.equal(averaged.means[-60:], last.means[-60:])


def test_a_block_is_averaged_too(scene: Scene) -> None:
    initial = trained(list(train(coarse(scene, config(0.0)))))
    cell = Cell(aabb(scene.centers, 5.0), Grid((2, 1, 1)), 1)
    blocks = []
    for part in (0.25, 0.0):
        settings = {"stage2": {"exterior": "baked"}, "densify": {"until": 0}}
        block = replace(coarse(scene, config(part, **settings)), task=TaskId.block(1), views=(0, 2))
        blocks.append(trained(list(train(replace(block, initial=Value(initial), cell=cell)))))
    assert abs(len(blocks[0]) - len(blocks[1])) < 5 and len(blocks[0])
    assert not torch.equal(blocks[0].sh0[:5], blocks[1].sh0[:5])


def test_it_is_averaged_on_a_card_as_on_the_cpu(scene: Scene) -> None:
    settings = {"sky": {"count": 10}, "densify": {"until": 0}, "reset": {"quiet": 1.0}}
    spec = replace(coarse(scene, config(0.5, **settings)), width=WIDTH // 2, iterations=6)
    expected = trained(list(train(spec)))
    with stubbed(EmulatedLaunch()):
        found = trained(list(train(spec)))
    assert len(found) == len(expected)
    assert torch.allclose(found.means, expected.means, atol=1e-3)


def test_without_models_the_average_is_the_latest(scene: Scene) -> None:
    average = Average()
    model = trained(list(train(coarse(scene, config(0.0)))))
    assert average.take(model) is model and not average.tensors()
    average.add(model)
    average.clear()
    assert average.take(model) is model
