"""The image cache of a task: what the settings say, and what the place leaves where they say nothing."""

from dataclasses import replace

import pytest

from panolog.orchestrator.driver.demands import image_cache
from panolog.orchestrator.resources.nodes import Gpu, Node, Placement
from panolog.workers.training.config import CacheConfig

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
