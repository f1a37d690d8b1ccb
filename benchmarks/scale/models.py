"""Levels of detail of larger and larger cities."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.processes import in_fresh_process, peak_memory, resident_memory
from benchmarks.scale.places import city
from panolog.orchestrator.engine.estimates.suggestions import balanced
from panolog.orchestrator.engine.stages.surroundings import Surroundings
from panolog.orchestrator.runs.config import RunConfig, change
from panolog.partition.contraction import contract
from panolog.renderer.process import release_memory
from panolog.scene.model import Scene
from panolog.scene.ply import write_ply
from panolog.workers.meter import reset_peaks
from panolog.workers.training.initialise import isotropic

PER_BLOCK = 75  # panoramas
_WIDTH = 1024  # pixels
_SPREAD = 0.3  # metres from a point to the Gaussians that stand for it
_CUTS = 4  # blocks whose files are measured


@dataclass(frozen=True)
class LevelsRow:
    """The levels of detail of a city's Stage I model, as the driver makes and uses them."""

    panoramas: int
    blocks: int
    gaussians: int
    seconds: float  # to make them
    memory: float  # bytes of a Gaussian, at the peak, beyond the model itself
    cut: float  # seconds to write what a block starts from
    starts: int  # Gaussians of others in that, on average


def hierarchies(folder: Path, sizes: Sequence[int], each: int) -> Iterator[LevelsRow]:
    """Levels of detail of cities of so many panoramas, each with `each` Gaussians."""
    for panoramas in sizes:
        yield in_fresh_process(_hierarchy, folder, panoramas, each)


def _hierarchy(folder: Path, panoramas: int, each: int) -> LevelsRow:
    scene = city(panoramas, _WIDTH)
    config = RunConfig.model_validate({"width": _WIDTH, "device": "cpu", "stage2": {"detail": 1.0}})
    config = change(config, balanced(scene, config, max(2, round(panoramas / PER_BLOCK))))
    whole = folder / "whole.ply"
    count = _write_model(whole, scene, each)
    reset_peaks("cpu")
    before, began = resident_memory(), time.perf_counter()
    levels = Surroundings(scene, whole, config, _WIDTH)
    seconds, peak = time.perf_counter() - began, peak_memory()
    blocks = config.grid.count
    chosen = range(0, blocks, max(1, blocks // _CUTS))
    began, counts = time.perf_counter(), []
    for block in chosen:
        path = folder / "initial.ply"
        levels.write(path, (block,), _cameras(scene, config, block))
        counts.append(path.stat().st_size // (62 * 4) - levels.sizes[block])
        path.unlink()
    whole.unlink()
    cut = (time.perf_counter() - began) / len(chosen)
    memory = (peak - before) / count
    return LevelsRow(panoramas, blocks, count, seconds, memory, cut, round(sum(counts) / len(counts)))


def _write_model(path: Path, scene: Scene, each: int) -> int:
    """Gaussians around the sparse points, as large as the distance to their neighbours; returns how many."""
    random = np.random.default_rng(0)
    means = scene.points[random.integers(0, len(scene.points), each * len(scene.panoramas))]
    means = means + _SPREAD * random.standard_normal(means.shape)
    apart = cKDTree(means).query(means, k=2)[0][:, 1].clip(1e-3)
    write_ply(path, isotropic(means, apart, np.full((len(means), 3), 0.5), 0.5))
    release_memory()
    return len(means)


def _cameras(scene: Scene, config: RunConfig, block: int) -> list[int]:
    """The training panoramas that stand in a block."""
    train = np.array(scene.train)
    box = config.partition.box(scene.centers[train])
    rows: list[int] = train[config.grid.block_of(contract(scene.centers[train], box)) == block].tolist()
    return rows
