"""The merge of a very large run: its peak memory, its speed compared with a plain copy, and a power law.

A run folder is filled with random models, as a driver leaves it when all blocks are trained. Then one process
joins the files with `cat`, another merges the run as the driver does, and a third runs `cat` again. Each turn
begins with the files out of the page cache and ends when its result is on the disk.
"""

import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.processes import drop_from_page_cache, in_fresh_process, peak_memory
from benchmarks.rasterizer.cases import street
from panolog.orchestrator.engine.stages.merging import merge_run
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.records import BlockPlan, ModelSaved, PlanSaved, Record
from panolog.orchestrator.runs.state import replay
from panolog.orchestrator.runs.store import Database, read_milestones
from panolog.orchestrator.runs.units import gib
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan, read_plan
from panolog.partition.regions import Regions
from panolog.scene.errors import InputError, RunError
from panolog.scene.ply import COLUMNS, ply_header, write_ply
from panolog.workers.tasks import COARSE, TaskId

SKY = 100_000  # the default of `sky.count`
ROW = 4 * len(COLUMNS)  # bytes
_PIECE = 2**20  # bytes compared at a time


@dataclass(frozen=True)
class MergeRow:
    """One merge."""

    blocks: int
    gaussians: int
    seconds: float
    speed: float  # 1e6 bytes of the result per second
    cat: float  # the same of `cat` of the same files, before and after it
    memory: float  # 1e6 bytes of its process beyond what it had before


def merges(folder: Path, sizes: Sequence[int], each: int) -> Iterator[MergeRow]:
    """Merges of so many Gaussians in blocks of `each`, one after another. Raises as `measure`."""
    for size in sizes:
        with TemporaryDirectory(dir=folder) as root:
            yield measure(Path(root), max(2, size // each), size, seed=0)


def measure(root: Path, blocks: int, gaussians: int, seed: int) -> MergeRow:
    """Fills the folder `root` and measures the three turns.

    Raises InputError if the disk is too small, RunError if the merged model is not what the blocks hold.
    """
    size = (gaussians + SKY) * ROW
    if shutil.disk_usage(root).free < 2.1 * size:
        raise InputError(f"{root}: needs {gib(2.1 * size)} of free disk; make room or give another folder")
    folder = RunFolder(root)
    sources = fill(folder, blocks, gaussians, seed)
    output = folder.point_cloud
    first = _cat(sources, output)
    _reset(sources, output)
    # in a fresh process, which has the memory of a driver that does nothing else
    seconds, before, peak = in_fresh_process(merge, folder)
    _check(sources, output)
    mega = output.stat().st_size / 1e6
    cat = (first + _cat(sources, output)) / 2
    return MergeRow(blocks, gaussians, seconds, mega / seconds, cat, (peak - before) / 1e6)


def fill(folder: RunFolder, blocks: int, gaussians: int, seed: int) -> list[Path]:
    """Writes a run whose blocks are all trained, of random sizes; returns the files that its merge joins."""
    random = np.random.default_rng(seed)
    sizes = random.multinomial(gaussians, random.dirichlet(np.full(blocks, 4.0))).tolist()
    records: list[Record] = []
    models: list[Path] = []
    for block, size in enumerate(sizes):
        name = TaskId.block(block)
        models.append(folder.model(name))
        models[-1].parent.mkdir(parents=True)
        write_ply(models[-1], street(size, sky=0.0, seed=seed + block))
        records.append(ModelSaved(name, folder.relative(models[-1]), size, size * ROW, 1, 0.0))
    models.append(folder.model(COARSE))
    models[-1].parent.mkdir()
    write_ply(models[-1], street(SKY, sky=1.0, seed=seed))
    _write_plan(folder, sizes)
    plan = tuple(BlockPlan(block, 2, size, train=True) for block, size in enumerate(sizes))
    with closing(Database(folder.database)) as database:
        database.append([PlanSaved(folder.relative(folder.plan), plan), *records])
    return models


def _write_plan(folder: RunFolder, sizes: Sequence[int]) -> None:
    """A plan of two cameras whose blocks lie in a row and hold `sizes` Gaussians of Stage I."""
    centers, blocks = np.array([[0.0, 0, 0], [1.0, 0, 0]]), len(sizes)
    grid, scores = Grid((blocks, 1, 1)), np.ones((2, blocks))
    plan = make_plan(centers, centers, scores, grid, PartitionConfig(), rows=(0, 1), names=("a", "b"))
    plan.gaussians[:] = sizes
    folder.make(folder.plan.parent)
    write_json(folder.plan, plan.to_json())


def _reset(sources: Sequence[Path], output: Path) -> None:
    """Removes the output, and the sources from the page cache."""
    output.unlink(missing_ok=True)
    for path in sources:
        drop_from_page_cache(path)


def _cat(sources: Sequence[Path], output: Path) -> float:
    """1e6 bytes of the result per second."""
    _reset(sources, output)
    started = time.perf_counter()
    with output.open("wb") as file:
        subprocess.run(["cat", *sources], stdout=file, check=True)
        os.fsync(file.fileno())
    return output.stat().st_size / (time.perf_counter() - started) / 1e6


def merge(folder: RunFolder) -> tuple[float, int, int]:
    """Seconds of the merge of a run, and peak memory of this process before and after it, in bytes."""
    before, started = peak_memory(), time.perf_counter()
    plan = read_plan(folder.plan)
    unrepaired = Regions(plan.aabb, plan.grid, (), reach=0.0)
    merge_run(folder, replay(read_milestones(folder.database)), plan, unrepaired)
    return time.perf_counter() - started, before, peak_memory()


def _check(sources: Sequence[Path], output: Path) -> None:
    """Raises RunError unless `output` holds the rows of all sources, in order, to the byte."""
    counts = [ply_header(path)[0] for path in sources]
    if ply_header(output) != (sum(counts), SKY):
        raise RunError(f"{output} does not hold {sum(counts)} Gaussians, {SKY} of them sky")
    with output.open("rb") as merged:
        merged.seek(-sum(counts) * ROW, os.SEEK_END)
        for path, count in zip(sources, counts, strict=True):
            with path.open("rb") as part:
                part.seek(-count * ROW, os.SEEK_END)
                while piece := part.read(_PIECE):
                    if merged.read(len(piece)) != piece:
                        raise RunError(f"{output} differs from {path}")


def exponent(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """(factor, exponent) of the power law through positive values, least squares of the logarithms."""
    slope, offset = np.polyfit(np.log(sizes), np.log(values), 1)
    return float(np.exp(offset)), float(slope)
