"""The states of a run on its way, kept without copies and put together as a merge would."""

from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.snapshots import State, _assembled
from panolog.partition.cells import Grid
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply
from panolog.workers.events import Checkpoint
from panolog.workers.merge import retained
from panolog.workers.tasks import TaskId
from panolog.workers.training.checkpoint import save
from panolog.workers.training.initialise import isotropic
from panolog.workers.training.optimizer import ModelState
from tests.partition.test_plan import CENTERS, planned


def gaussians(count: int, sky: int, opacity: float = 0.5, seed: int = 0) -> Gaussians:
    random = np.random.default_rng(seed)
    made = isotropic(
        random.normal(size=(count, 3)) * 20, np.full(count, 0.1), np.full((count, 3), 0.5), opacity
    )
    return made.with_tensors(made.tensors(), sky)


def checkpoint(path: Path, task: TaskId, iteration: int, model: Gaussians) -> None:
    save(path, Checkpoint(task, iteration, ModelState.start(model).tensors()))


def test_a_state_is_what_a_merge_would_give(tmp_path: Path) -> None:
    coarse, better = gaussians(200, 20), gaussians(200, 20, opacity=0.9)
    grid = Grid((2, 1, 1))
    means = coarse.means[coarse.scene].numpy()
    plan = planned(CENTERS, means, np.zeros((len(CENTERS), 2)), grid)
    path, ply = tmp_path / "a.safetensors", tmp_path / "model.ply"
    checkpoint(path, TaskId.block(1), 5, better)
    model = _assembled(coarse, plan, [State(1.0, TaskId.block(1), path)])
    assert (len(model), model.sky) == (200, 20)
    inside = plan.cell(1).contains(model.means[model.scene].numpy())
    assert 0 < inside.sum() < 180
    torch.testing.assert_close(model.opacities[:180][inside], torch.full((int(inside.sum()),), 2.1972246))
    torch.testing.assert_close(model.opacities[:180][~inside], torch.zeros(180 - int(inside.sum())))
    write_ply(ply, retained(better, plan.cell(0), 0.0))  # block 0 has ended
    both = _assembled(coarse, plan, [State(1.0, TaskId.block(1), path), State(2.0, TaskId.block(0), ply)])
    assert float(both.opacities[:180].min()) > 2
    assert torch.equal(both.means[180:], coarse.means[180:])
