"""What tasks demand, and the image cache: what the settings say, or what the place leaves."""

from dataclasses import replace
from pathlib import Path

import pytest

from panolog.orchestrator.driver.demands import Sizes, image_cache
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.resources.nodes import Gpu, Node, Placement
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Merged
from panolog.orchestrator.run.state import RunState
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE, EVAL, TaskId
from panolog.workers.training.config import CacheConfig
from panolog.workers.training.initialise import scene_gaussians
from tests.workers.small import WIDTH, small_scene

GIB = 2**30
NODE = Node("a", "host", cpus=16, memory=64 * GIB, gpus=(Gpu(memory=24 * GIB), Gpu(memory=24 * GIB)))
HALF = Placement("a", cpus=8.0, memory=24 * GIB, gpus=1.0, gpu=0, kind="GPU")  # one of its two GPUs
NEED = 6 * GIB


def test_on_the_cpu_the_settings_hold() -> None:
    for cache in (CacheConfig(), CacheConfig(memory=7.0, device=3.0)):
        assert image_cache(cache, Placement("a", cpus=4.0, memory=64 * GIB), NODE, NEED, 0) == cache


def test_on_a_gpu_the_defaults_follow_free_memory() -> None:
    found = image_cache(CacheConfig(), HALF, NODE, NEED, 0)
    assert found.memory == 64 / 2 / 2
    assert found.device == pytest.approx(0.9 * 24 - 6)
    full = image_cache(CacheConfig(), HALF, NODE, 40 * GIB, 0)
    assert full.device == 0


def test_on_a_gpu_a_small_machine_keeps_the_least() -> None:
    found = image_cache(CacheConfig(), HALF, replace(NODE, memory=0), NEED, 0)
    assert found.memory == CacheConfig().memory


def test_on_a_gpu_what_is_set_holds() -> None:
    cache = CacheConfig(memory=5.0, device=1.0)
    assert image_cache(cache, HALF, NODE, NEED, 0) == cache


def test_a_shortage_leaves_nothing_on_the_gpu() -> None:
    found = image_cache(CacheConfig(memory=8.0, device=1.0), HALF, NODE, NEED, 1)
    assert (found.memory, found.device) == (2.0, 0.0)


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
