"""The average of the last models of a task, in place of the last one."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.scene.model import Scene
from panolog.workers.specs import Value
from panolog.workers.training.checkpoint import SavedModel, save
from panolog.workers.training.config import TrainConfig
from panolog.workers.training.schedule import AVERAGED, Schedule
from panolog.workers.training.trainer import train
from tests.renderer.cuda.emulation import EmulatedLaunch
from tests.renderer.cuda.stubbed import stubbed
from tests.workers.small import WIDTH
from tests.workers.trainings import checkpoints, coarse_of, same, settings, trained, unchanged

ITERATIONS = 24
CALM = {"reset": {"quiet": 1.0}}


def config(average: float, **groups: Any) -> TrainConfig:
    return settings(optimizer={"average": average}, checkpoint={"every": 1}, **groups)


@pytest.mark.parametrize("iterations", [10, 24, 500, 30_000])
@pytest.mark.parametrize("average", [0.05, 0.125, 1 - 1e-9])
def test_some_models_count_the_last_among_them(iterations: int, average: float) -> None:
    schedule = Schedule(config(average), iterations, 1.0, refine=False)
    counted = [it for it in range(1, iterations + 1) if schedule.averages(it)]
    assert counted[-1] == iterations and counted[0] > iterations * (1 - average)
    assert 1 <= len(counted) <= 2 * AVERAGED
    assert len(counted) >= min(AVERAGED, int(iterations * average))
    assert len({b - a for a, b in pairwise(counted)}) <= 1
    without = Schedule(config(0.0), iterations, 1.0, refine=False)
    assert not any(without.averages(it) for it in range(1, iterations + 1))


def test_the_model_is_the_mean_of_the_last_ones(scene: Scene) -> None:
    events = list(train(coarse_of(scene, config(0.25, **CALM))))
    last = trained(coarse_of(scene, config(0.0, **CALM))).tensors()
    found = trained(events).tensors()
    assert torch.equal(found["means"][-60:], last["means"][-60:])  # the sky stays where it is
    states = [*(event.tensors for event in checkpoints(events)), last][-6:]
    for name in ("means", "shN", "opacities"):
        expected = torch.stack([state[name].double() for state in states]).mean(0)
        assert torch.allclose(found[name].double(), expected, rtol=1e-6, atol=1e-7)
        assert not torch.equal(found[name], last[name])


def test_the_model_of_a_checkpoint_is_the_mean_so_far(scene: Scene, tmp_path: Path) -> None:
    events = checkpoints(train(coarse_of(scene, config(0.25, **CALM))))
    save(tmp_path / "last", events[-1])
    pieces = [piece.tensors() for piece in SavedModel(tmp_path / "last").pieces(rows=100)]
    for name in ("means", "shN", "opacities"):
        expected = torch.stack([event.tensors[name].double() for event in events[-5:]]).mean(0)
        found = torch.cat([piece[name] for piece in pieces]).double()
        assert torch.allclose(found, expected, rtol=1e-6, atol=1e-7)


def test_a_resume_does_not_change_what_it_started_from(scene: Scene) -> None:
    spec = coarse_of(scene, config(0.25))
    *_, event = checkpoints(train(spec))
    before = {name: tensor.clone() for name, tensor in event.tensors.items()}
    list(train(replace(spec, checkpoint=Value(event))))
    assert unchanged(before, event.tensors)


def test_only_models_with_the_same_rows_count(scene: Scene) -> None:
    """Densification continues until 20 of 24 iterations, resets until 18."""
    densify = {"until": 26_000, "max_gaussians": 0}
    long, short = (
        trained(coarse_of(scene, config(part, densify=densify))) for part in (0.99, 4 / ITERATIONS)
    )
    assert same(long, short)


def test_it_is_averaged_on_a_card_as_on_the_cpu(scene: Scene) -> None:
    chosen = config(0.5, sky={"count": 10}, densify={"until": 0}, **CALM)
    spec = coarse_of(scene, chosen, width=WIDTH // 2, iterations=6)
    expected = trained(spec)
    with stubbed(EmulatedLaunch()):
        found = trained(spec)
    assert len(found) == len(expected)
    assert torch.allclose(found.means, expected.means, atol=1e-3)
