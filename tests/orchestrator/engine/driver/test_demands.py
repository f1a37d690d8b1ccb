"""What tasks demand, and the image cache: what the settings say, or what the place leaves."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.engine.driver.demands import Sizes, image_cache
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.estimates import estimate
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.orchestrator.runs.records import BlockPlan, Merged
from panolog.orchestrator.runs.state import RunState
from panolog.scene.ply import write_ply
from panolog.workers.growth import Period, population
from panolog.workers.tasks import COARSE, EVAL, TaskId
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.task_config import CacheConfig
from tests.workers.small import WIDTH, small_scene

GIB = 2**30
NODE = Node("a", "host", cpus=16, memory=64 * GIB, gpus=(Gpu(memory=24 * GIB), Gpu(memory=24 * GIB)))
HALF = Placement("a", cpus=8.0, memory=24 * GIB, gpus=1.0, gpu=0, kind="GPU")  # one of its two GPUs
SET = CacheConfig(memory=5.0, device=1.0)
LEAST = CacheConfig().memory


@pytest.mark.parametrize(
    ("cache", "where", "memory", "need", "shortages", "expected"),
    [
        (CacheConfig(), replace(HALF, gpu=None), 64, 6, 0, (LEAST, None)),  # on the CPU the settings hold
        (SET, replace(HALF, gpu=None), 64, 6, 0, (5.0, 1.0)),
        (CacheConfig(), HALF, 64, 6, 0, (64 / 2 / 2, 0.9 * 24 - 6)),  # on a GPU, what is free
        (CacheConfig(), HALF, 64, 40, 0, (64 / 2 / 2, 0.0)),
        (CacheConfig(), HALF, 0, 6, 0, (LEAST, 0.9 * 24 - 6)),  # a small machine
        (SET, HALF, 64, 6, 0, (5.0, 1.0)),
        (SET, HALF, 64, 6, 1, (1.25, 0.0)),  # after a shortage nothing on the GPU
    ],
)
def test_the_image_cache_is_as_set_or_what_its_place_leaves(
    cache: CacheConfig,
    where: Placement,
    memory: int,
    need: int,
    shortages: int,
    expected: tuple[float, float | None],
) -> None:
    found = image_cache(cache, where, replace(NODE, memory=memory * GIB), need * GIB, shortages)
    assert (found.memory, found.device) == pytest.approx(expected)


def test_the_growth_of_few_blocks_is_forecast_for_thousands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forecasts: list[int] = []

    def counted(start: int, *rest: Any) -> list[Period]:
        forecasts.append(start)
        return population(start, *rest)

    monkeypatch.setattr(estimate, "population", counted)
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path / "run")
    folder.model(COARSE).parent.mkdir(parents=True)
    write_ply(folder.model(COARSE), scene_gaussians(scene))
    blocks = tuple(BlockPlan(i, 3, 1000 + i, train=True) for i in range(3000))
    sizes = Sizes(Job(folder, scene, RunConfig(width=WIDTH, device="cpu")))
    state = RunState(plan=blocks)
    bytes_ = [sizes.of(TaskId.block(block.block), state) for block in blocks]
    assert bytes_ == sorted(bytes_) and bytes_[0] < bytes_[-1]
    assert len(forecasts) < 100


def test_shards_demand_what_their_cameras_distinguish(tmp_path: Path) -> None:
    """Here of a cloud whose points lie where others do, so that few are enough."""
    scene, count = small_scene(tmp_path), 100_000
    folder = RunFolder(tmp_path / "run")
    folder.model(COARSE).parent.mkdir(parents=True)
    dense = replace(scene, points=scene.points.repeat(count // len(scene.points), axis=0))
    cloud = scene_gaussians(small_scene(tmp_path / "many", points=count))
    write_ply(folder.model(COARSE), cloud)
    state = RunState(merged=Merged("point_cloud.ply", count, 0, 1, 0.1))
    sizes = {}
    for detail in (0.0, 2.0):
        settings = {"width": WIDTH, "device": "cpu", "sky": {"count": 0}, "stage2": {"detail": detail}}
        config = RunConfig.model_validate(settings)
        of = Sizes(Job(folder, dense, config)).of
        sizes[detail] = [of(task, state) for task in (EVAL, TaskId.shard(0), TaskId.measure(0))]
    whole, score, measure = sizes[2.0]
    assert sizes[0.0][:2] == [whole, whole]
    assert max(score, measure) < whole - count * 300
