"""Models, and runs that have them, for the tests of pages in 3D."""

from collections.abc import Sequence

import numpy as np
import torch

from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply
from panolog.workers.events import Checkpoint
from panolog.workers.showing.previews import snapshot
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import ModelState

CENTERS = np.array([[x, 5.0, x % 2] for x in range(6)])
NAMES = [f"{i}.jpg" for i in range(6)]


def some(count: int, sky: int = 0, seed: int = 0) -> Gaussians:
    """Random Gaussians about (10, 20, 30); the sky ones far away and large."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    far = torch.arange(count) >= count - sky
    offsets = torch.nn.functional.normalize(normal(count, 3), dim=1) * torch.where(far, 500.0, 2.0)[:, None]
    return Gaussians(
        means=offsets + torch.tensor([10.0, 20.0, 30.0]),
        quats=normal(count, 4),
        scales=normal(count, 3) * 0.2 + torch.where(far, 1.0, -4.0)[:, None],
        opacities=normal(count),
        sh0=normal(count, 1, 3),
        shN=torch.zeros(count, 15, 3),
        sky=sky,
    )


def save_model(folder: RunFolder, task: TaskId, count: int = 20, sky: int = 0) -> None:
    """The model that a task ended with."""
    folder.of(task).mkdir(parents=True, exist_ok=True)
    write_ply(folder.model(task), some(count, sky))


def save_checkpoint(folder: RunFolder, task: TaskId, count: int = 20, iteration: int = 5) -> None:
    """A checkpoint of a task, two of its Gaussians sky."""
    folder.of(task).mkdir(parents=True, exist_ok=True)
    checkpoint.save(
        folder.checkpoint(task), Checkpoint(task, iteration, ModelState.start(some(count, 2)).tensors())
    )


def save_snapshot(folder: RunFolder, model: Gaussians, iteration: int = 5, most: int = 10**6) -> None:
    """What Stage I in training shows of a model."""
    folder.of(COARSE).mkdir(parents=True, exist_ok=True)
    tensors = snapshot(model, np.zeros(3), most)
    checkpoint.save(folder.snapshot(COARSE), Checkpoint(COARSE, iteration, tensors))


def save_plan(folder: RunFolder, names: Sequence[str] = NAMES, centers: np.ndarray = CENTERS) -> None:
    """A plan of two blocks."""
    plan = make_plan(
        centers,
        some(20).means.numpy(),
        np.zeros((len(names), 2)),
        Grid.parse("2x1x1"),
        PartitionConfig(),
        rows=range(len(names)),
        names=list(names),
    )
    folder.make(folder.plan.parent)
    write_json(folder.plan, plan.to_json())
