"""Writes the run folder of a run of any size without running it: for `benchmarks.dashboard`."""

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from benchmarks.driver_scale.simulated_pool import grid
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.orchestrator.run.info import SceneRef, make_info, write_info
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    ModelSaved,
    Noticed,
    PreviewSaved,
    Progressed,
    Record,
    RunBegan,
    ScoresSaved,
    TaskStarted,
    task_name,
)
from panolog.orchestrator.run.store import Database, to_json
from panolog.orchestrator.stages.partitioning import plan_records
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.workers.tasks import COARSE, TaskId

RATES = {"means": 1e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
_CAMERAS = 2  # for each block, unless given
_SERIES = ("rate", "loss", "psnr", "gaussians", "memory")
_BATCH = 50_000  # records in a transaction
_BEGAN = 1.8e9  # seconds since the epoch
_EVERY = 20  # progress records for each checkpoint and preview
_INDEX = "CREATE INDEX metric_series ON metrics (task, name, iteration)"


@dataclass(frozen=True)
class RunSize:
    """The size of the run."""

    blocks: int
    events: int  # about
    together: int  # blocks that trained at a time, and still do
    cameras: int = 0  # of the plan, which has a score of each for every block; 0 = two for each block


def write_run(root: Path, size: RunSize) -> RunFolder:
    """Writes a run whose last `together` blocks are half done: about a kilobyte for each event."""
    folder = RunFolder(root)
    root.mkdir(parents=True)
    shape = grid(size.blocks)
    config = RunConfig(iterations=30_000, width=4096, blocks=str(shape), device="cuda")
    scene = SceneRef(path=str(root / "scene"), fingerprint="0" * 64)
    write_info(folder, make_info(scene, config))
    plan = _plan(size)
    write_json(folder.plan, plan.to_json())
    np.savez(folder.scores, cameras=np.array(plan.rows, np.int64), scores=plan.scores)
    Database(folder.database).close()
    with closing(sqlite3.connect(folder.database)) as connection:
        connection.executescript("PRAGMA synchronous = OFF; DROP INDEX metric_series")
        _write(connection, _history(folder, plan, size, config.iterations))
        connection.execute(_INDEX)
    return folder


def _plan(size: RunSize) -> Plan:
    """Cameras all over the grid, with the scores of a scene in which each sees the few blocks around it."""
    random = np.random.default_rng(0)
    shape, count = grid(size.blocks), size.cameras or _CAMERAS * size.blocks
    centers = random.uniform(-1, 1, (count, 3)) * [500, 500, 20]
    middles = random.uniform(-1, 1, (size.blocks, 3)) * [500, 500, 20]
    return make_plan(
        centers,
        random.uniform(-1, 1, (200 * size.blocks, 3)) * [800, 800, 50],
        np.exp(-cdist(centers, middles) / 20),
        shape,
        PartitionConfig(),
        rows=range(count),
        names=[f"walk_{row // 100:02d}/{row:06d}.jpg" for row in range(count)],
    )


def _history(folder: RunFolder, plan: Plan, size: RunSize, iterations: int) -> Iterator[Record]:
    """All records in order: blocks take turns, as many at a time as train together."""
    yield RunBegan("head", 1, resumed=False)
    yield _started(COARSE)
    yield from (_progressed(COARSE, k, iterations, 1000) for k in range(1, 1001))
    yield ModelSaved(COARSE, "coarse/model.ply", 20_000_000, 5_000_000_000, iterations, 3_600.0)
    for shard in range(size.blocks // 8 + 1):
        yield _started(TaskId.shard(shard))
        yield ScoresSaved(TaskId.shard(shard), f"partition/scores/{shard:03d}.npz", 16)
    yield from plan_records(folder, plan)
    steps = max(2, (size.events - 1000) // max(1, size.blocks - size.together // 2))
    for first in range(0, size.blocks, size.together):
        names = [TaskId.block(b) for b in range(first, min(first + size.together, size.blocks))]
        yield from map(_started, names)
        last = first + size.together >= size.blocks
        for step in range(1, (steps // 2 if last else steps) + 1):
            for name in names:
                yield from _step(name, step, steps, iterations)
        for name in () if last else names:
            path = folder.relative(folder.model(name))
            yield ModelSaved(name, path, 400_000, 100_000_000, iterations, 1_800.0)


def _started(task: TaskId) -> TaskStarted:
    node = f"node-{sum(str(task).encode()) % 25:02d}"
    return TaskStarted(task, 1, 0, node, 4_242, "cuda", 4, "NVIDIA L4", 4.0)


def _step(task: TaskId, step: int, steps: int, iterations: int) -> Iterator[Record]:
    yield _progressed(task, step, iterations, steps)
    if step % _EVERY == 0:
        done = step * iterations // steps
        folder = f"blocks/{task.number:03d}"
        yield CheckpointSaved(task, done, f"{folder}/checkpoint.safetensors", 400_000_000)
        yield PreviewSaved(task, done, "walk_00/000001.jpg", f"{folder}/previews/{done:06d}.jpg")
    if step == steps // 3:
        yield Noticed(task, "walk_00/000007.jpg: left out of the depth loss, its alignment is implausible")


def _progressed(task: TaskId, step: int, iterations: int, steps: int) -> Progressed:
    done = step / steps
    return Progressed(
        task,
        step * iterations // steps,
        iterations,
        9.0 + step % 7 / 10,
        0.05 + 0.2 / (1 + 20 * done) + step % 13 / 1_000,
        20 + 8 * done + step % 11 / 10,
        100_000 + int(300_000 * done),
        6_000_000_000,
        3_000_000_000,
        {name: value * (1 - 0.9 * done) for name, value in RATES.items()},
    )


def _write(connection: sqlite3.Connection, records: Iterable[Record]) -> None:
    """As `Database.append` would, a second of the run for every hundred records, in larger transactions."""
    numbered = enumerate(records, 1)
    while batch := [(number, _BEGAN + number / 100, it) for number, it in islice(numbered, _BATCH)]:
        events = [(number, time, task_name(it), type(it).__name__, to_json(it)) for number, time, it in batch]
        series = [
            (str(it.task), name, it.iteration, time, value)
            for _, time, it in batch
            if isinstance(it, Progressed)
            for name, value in _values(it)
        ]
        with connection:
            connection.executemany("INSERT INTO events VALUES (?, ?, ?, ?, ?)", events)
            connection.executemany("INSERT INTO metrics VALUES (?, ?, ?, ?, ?)", series)


def _values(record: Progressed) -> Iterator[tuple[str, float]]:
    yield from ((name, getattr(record, name)) for name in _SERIES)
    yield from ((f"rate/{name}", value) for name, value in record.rates.items())
