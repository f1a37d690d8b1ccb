"""The plan of very many panoramas and blocks: its file, that of its scores, and what reading both takes."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from benchmarks.processes import in_fresh_process, peak_memory
from benchmarks.scale.simulated_pool import grid
from panolog.orchestrator.engine.stages.partitioning import write_plan
from panolog.orchestrator.runs.folder import RunFolder
from panolog.partition.plan import PartitionConfig, make_plan, read_plan
from panolog.partition.scores import read_scores

_GAUSSIANS = 100  # for each block


@dataclass(frozen=True)
class PlanSize:
    """One plan."""

    panoramas: int
    blocks: int
    seen: int  # blocks that a panorama has a score for, at most
    plan: float  # 1e6 bytes of plan.json
    scores: float  # 1e6 bytes of scores.npz
    write: float  # seconds to make and write both
    read: float  # seconds to read both
    memory: float  # peak of the process that makes and that reads them, 1e6 bytes


def measure(folder: Path, panoramas: int, blocks: int, seen: int) -> PlanSize:
    """Each panorama sees `seen` blocks at random, which compresses worse than the blocks around it."""
    root = RunFolder(folder / f"{panoramas}-{blocks}")
    root.root.mkdir()
    write, made = in_fresh_process(_write, root, panoramas, blocks, seen)
    read, used = in_fresh_process(_read, root)
    plan, scores = (path.stat().st_size / 1e6 for path in (root.plan, root.scores))
    return PlanSize(panoramas, blocks, seen, plan, scores, write, read, max(made, used) / 1e6)


def _write(folder: RunFolder, panoramas: int, blocks: int, seen: int) -> tuple[float, int]:
    random = np.random.default_rng(0)
    centers = random.uniform(-1, 1, (panoramas, 3)) * [5_000, 5_000, 20]
    means = random.uniform(-1, 1, (_GAUSSIANS * blocks, 3)) * [5_000, 5_000, 50]
    pairs = np.repeat(np.arange(panoramas), seen), random.integers(0, blocks, panoramas * seen)
    scores = csr_array((random.random(panoramas * seen) ** 4, pairs), shape=(panoramas, blocks))
    names, began = [f"walk_{k // 100:04d}/{k:06d}.jpg" for k in range(panoramas)], time.perf_counter()
    config = PartitionConfig()
    plan = make_plan(centers, means, scores, grid(blocks), config, rows=range(panoramas), names=names)
    write_plan(folder, plan, scores)
    return time.perf_counter() - began, peak_memory()


def _read(folder: RunFolder) -> tuple[float, int]:
    began = time.perf_counter()
    plan = read_plan(folder.plan)
    read_scores(folder.scores, plan.rows, plan.grid.count)
    return time.perf_counter() - began, peak_memory()
