"""Levels of detail of all blocks, from a model that is read in pieces."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from panolog.orchestrator.engine.stages import surroundings
from panolog.orchestrator.engine.stages.partitioning import block_labels
from panolog.orchestrator.engine.stages.surroundings import Surroundings
from panolog.orchestrator.runs.config import RunConfig
from panolog.partition.levels import make_levels
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply, write_ply
from panolog.workers.training.initialise import scene_gaussians, scene_length
from tests.workers.small import WIDTH, small_scene


@pytest.mark.parametrize("rows", [7, 10_000])
def test_they_are_those_of_each_block_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    monkeypatch.setattr(surroundings, "_ROWS", rows)
    scene, path = small_scene(tmp_path / "scene"), tmp_path / "model.ply"
    start = scene_gaussians(scene)
    model = Gaussians(**start.tensors(), sky=11, exact=True)
    write_ply(path, model)
    config = RunConfig.model_validate({"blocks": "2x2x1", "stage2": {"exterior": "baked", "detail": 6.0}})
    found = Surroundings(scene, path, config, WIDTH)

    means = model.means[model.scene].numpy()
    labels = torch.from_numpy(block_labels(scene, means, config))
    sizes = torch.bincount(labels, minlength=4)
    assert found.sizes == tuple(sizes.tolist()) and sizes.min() > 0
    angle, cameras = 6.0 * 2 * math.pi / WIDTH, scene.train[:2]
    inside = torch.cat([labels, torch.full((model.sky,), -1)])
    parts = []
    for block in range(4):
        own = Gaussians(**model.select(inside == block).tensors(), sky=0, exact=True)
        levels = make_levels(own, angle * scene_length(scene), surroundings._LOW_PASS / 6.0)
        parts.append(levels.rows(levels.cut(scene.centers[list(cameras)], angle)))
    blocks = found.write_seen(tmp_path / "seen.ply", scene.centers[list(cameras)])
    seen = read_ply(tmp_path / "seen.ply")
    assert blocks.tolist() == np.repeat(range(4), list(map(len, parts))).tolist()
    assert seen.exact and seen.sky == 11 and len(seen) < len(model)
    for name, tensor in seen.tensors().items():
        expected = [*(part.tensors()[name] for part in parts), model.tensors()[name][model.scene.stop :]]
        assert torch.equal(tensor, torch.cat(expected)), name
