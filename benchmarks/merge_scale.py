"""What the merge of a very large run needs: its peak memory, and its speed compared with a plain copy.

    python -m benchmarks.merge_scale [--blocks 200] [--gaussians 40000000] [--folder FOLDER] [--json]

A run folder is filled with random models, as a driver leaves it when all blocks are trained. Then one process
joins the files with `cat`, another merges the run as the driver does, and a third runs `cat` again. Each turn
begins with the files out of the page cache and ends when its result is on the disk.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.processes import drop_from_page_cache, in_fresh_process, peak_memory
from benchmarks.rasterizer.cases import street
from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.orchestrator.run.records import BlockPlan, ModelSaved, PlanSaved, Record
from panolog.orchestrator.run.state import replay
from panolog.orchestrator.run.store import Database, read_milestones
from panolog.orchestrator.run.units import gib
from panolog.orchestrator.stages.merging import merge_run
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan, read_plan
from panolog.partition.regions import Regions
from panolog.scene.errors import InputError, RunError
from panolog.scene.ply import COLUMNS, ply_header, write_ply
from panolog.workers.tasks import COARSE, TaskId

SKY = 100_000  # the default of `sky.count`
ROW = 4 * len(COLUMNS)  # bytes
HEAD = ("turn", "seconds", "MB/s", "peak MB", "peak MB before it began")
_PIECE = 2**20  # bytes compared at a time


@dataclass(frozen=True)
class JoinMeasurement:
    """One way to join all files into one."""

    name: str
    seconds: float
    speed: float  # 1e6 bytes of the result per second
    peak: float | None = None  # 1e6 bytes of resident memory of the process that did it
    before: float | None = None  # the same after the imports, before it read anything


def measure(root: Path, blocks: int, gaussians: int, seed: int) -> list[JoinMeasurement]:
    """Fills the folder `root` and measures the three turns.

    Raises InputError if the disk is too small, RunError if the merged model is not what the blocks hold.
    """
    size = (gaussians + SKY) * ROW
    if shutil.disk_usage(root).free < 2.1 * size:
        raise InputError(f"{root}: needs {gib(2.1 * size)} of free disk; make room or give --folder")
    folder = RunFolder(root)
    sources = fill(folder, blocks, gaussians, seed)
    output = folder.point_cloud
    before, merged = _cat(sources, output), _merge(root, sources, output)
    _check(sources, output)
    return [before, merged, _cat(sources, output)]


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
    write_json(folder.plan, plan.to_json())


def _reset(sources: Sequence[Path], output: Path) -> None:
    """Removes the output, and the sources from the page cache."""
    output.unlink(missing_ok=True)
    for path in sources:
        drop_from_page_cache(path)


def _cat(sources: Sequence[Path], output: Path) -> JoinMeasurement:
    _reset(sources, output)
    started = time.perf_counter()
    with output.open("wb") as file:
        subprocess.run(["cat", *sources], stdout=file, check=True)
        os.fsync(file.fileno())
    seconds = time.perf_counter() - started
    return JoinMeasurement("cat", seconds, output.stat().st_size / seconds / 1e6)


def _merge(root: Path, sources: Sequence[Path], output: Path) -> JoinMeasurement:
    """In a fresh process, which has the memory of a driver that does nothing else."""
    _reset(sources, output)
    seconds, before, peak = in_fresh_process(merge, RunFolder(root))
    return JoinMeasurement("merge", seconds, output.stat().st_size / seconds / 1e6, peak / 1e6, before / 1e6)


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


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("merge_scale", __doc__)
    parser.add_argument("--blocks", type=int, default=200)
    parser.add_argument("--gaussians", type=int, default=40_000_000, help="of all blocks together")
    parser.add_argument("--folder", type=Path, help="on the disk to measure; by default that of TMPDIR")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.quick:
        options.blocks, options.gaussians = 8, 20_000

    def work() -> report.Report:
        with tempfile.TemporaryDirectory(prefix="merge-", dir=options.folder) as folder:
            turns = measure(Path(folder), options.blocks, options.gaussians, options.seed)
        title = f"{options.blocks} blocks, {options.gaussians + SKY:,} Gaussians"
        table = report.markdown(HEAD, [astuple(turn) for turn in turns])
        return report.Report({"turns": [asdict(turn) for turn in turns]}, f"{title}\n\n{table}")

    return report.run("merge_scale", options, work)


if __name__ == "__main__":
    sys.exit(main())
