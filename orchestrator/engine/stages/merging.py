"""The merge in a run: which files make up the final model."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.orchestrator.engine.stages.captures import save_captured
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Merged, ModelSaved, Noticed, Record
from panolog.orchestrator.runs.state import RunState, Status
from panolog.partition.cells import Volume
from panolog.partition.contraction import contract
from panolog.partition.districts import Districts
from panolog.partition.plan import Plan
from panolog.partition.regions import Regions
from panolog.scene.errors import RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import (
    join_ply,
    ply_exact,
    ply_header,
    ply_offset,
    read_ply_chunks,
    read_sky,
    write_ply_parts,
)
from panolog.workers.capture.captured import Captured, joined
from panolog.workers.merge import merge, retained, retains
from panolog.workers.tasks import COARSE, MERGE, TaskId
from panolog.workers.training.checkpoint import SavedModel

_TRAINED = 0.5  # of its iterations, from which on a checkpoint is used: measured in docs/money.md


@dataclass(frozen=True, eq=False)
class Early:
    """How a run merges that a limit has ended early."""

    scene: Scene
    least: float  # opacity of what a block keeps
    iterations: int  # that a block was to train for

    def uses(self, folder: RunFolder, state: RunState, task: TaskId) -> bool:
        """Whether a block that has not ended is taken from its checkpoint, and not from Stage I."""
        done = state.task(task).checkpoint or 0
        return done >= _TRAINED * self.iterations and folder.checkpoint(task).exists()


def merge_run(
    folder: RunFolder, state: RunState, plan: Plan, margins: Regions, early: Early | None = None
) -> Merged:
    """Writes the merged model: every block as trained or else as Stage I left it, then the sky (eq. 13).

    Args: margins, what is near faces: where that was repaired, it is taken from there; early, of a run that a
    limit has ended: which blocks are taken from their checkpoints.
    Raises OSError, InputError or RunError if that fails.
    """
    started, faces = time.monotonic(), range(len(margins.faces))
    repaired = [face for face in faces if state.status(TaskId.repair(face)) == Status.DONE]

    def rest(piece: Gaussians) -> NDArray[np.bool_]:
        """(N,) what no repair has trained."""
        return np.isin(margins.of(piece.means.numpy()), repaired, invert=True)

    blocks = _block_plys(folder, state, plan, early)
    parts = {path: _rows(path, rest) if repaired else None for path in blocks}
    parts |= {folder.model(TaskId.repair(face)): None for face in repaired}
    merge(parts, folder.model(COARSE), folder.point_cloud)
    return _merged(folder, started)


def unite_blocks(folder: RunFolder, state: RunState, plan: Plan, task: TaskId) -> ModelSaved:
    """Writes the union of all blocks as they are by then, for the tasks of the next pass.

    Raises OSError, InputError or RunError if that fails.
    """
    started = time.monotonic()
    output = folder.model(task)
    folder.make(output.parent)
    count = merge(dict.fromkeys(_block_plys(folder, state, plan)), folder.model(COARSE), output)
    return _saved(folder, task, count, 0, started)


def _rows(path: Path, keep: Callable[[Gaussians], NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """(N,) which rows of a file to keep. Args: keep, (n,) which of a piece."""
    return np.concatenate([np.empty(0, np.bool_), *map(keep, read_ply_chunks(path))])


def join_districts(folder: RunFolder, scene: Scene, districts: Districts, iterations: int) -> ModelSaved:
    """Writes the Stage I model: what each district has in its cell, in order, and the mean of their skies.

    What they have learnt about how panoramas of the scene were captured is joined, too.

    Raises OSError, InputError or RunError if that fails.
    """
    started = time.monotonic()
    tasks = [TaskId.district(number) for number in range(districts.count)]
    learnt = [Captured.load(path) for task in tasks if (path := folder.captured(task)).exists()]
    if learnt:
        save_captured(folder, joined(learnt), scene)
    folder.make(folder.model(COARSE).parent)
    files = [(folder.model(task), districts.cell(task.number)) for task in tasks]
    return _saved(folder, COARSE, _join(folder.model(COARSE), files), iterations, started)


def _join(path: Path, files: Sequence[tuple[Path, Volume | None]]) -> int:
    """Writes what each file has in its cell, None = all, in order, and one sky; returns how many they are."""
    sky, first = _mean([read_sky(file) for file, _ in files]), files[0][0]
    parts = [(file, _rows(file, partial(_kept, cell=cell))) for file, cell in files]
    return join_ply(path, parts, sky, sky=len(sky), offset=ply_offset(first), exact=ply_exact(first))


def _kept(piece: Gaussians, cell: Volume | None) -> NDArray[np.bool_]:
    """(N,) what is in a cell, None = all; never sky."""
    scenery: NDArray[np.bool_] = np.arange(len(piece)) < piece.scene.stop
    return scenery if cell is None else retains(piece, cell, 0.0).numpy()


def _mean(skies: Sequence[Gaussians]) -> Gaussians:
    """Row by row: they began as the same. One that has lost rows, which were not finite, does not count."""
    most = max(map(len, skies))
    whole = [sky.tensors() for sky in skies if len(sky) == most]
    means = {name: torch.stack([sky[name] for sky in whole]).mean(0) for name in whole[0]}
    return skies[0].with_tensors(means, sky=most)


def merge_unfinished(
    folder: RunFolder, state: RunState, scene: Scene, tasks: Sequence[tuple[TaskId, Volume | None]]
) -> list[Record]:
    """Writes a model of a Stage I that a limit has ended: of each task its model, or its last checkpoint.

    Args: tasks of Stage I, each with the cell that it keeps, None = all. Of districts that have neither, a
    notice says that the model has nothing there. Raises as `merge_run`.
    """
    started, found = time.monotonic(), list[tuple[Path, Volume | None]]()
    for task, cell in tasks:
        if state.status(task) == Status.DONE:
            found.append((folder.model(task), cell))
        elif folder.checkpoint(task).exists():
            found.append((write_saved(folder, task, scene), cell))
    _join(folder.point_cloud, found)
    missing = len(tasks) - len(found)
    what = f"{missing} of {len(tasks)} districts were not begun: the model has nothing there"
    return [*([Noticed(MERGE, what)] if missing else []), _merged(folder, started)]


def write_saved(
    folder: RunFolder, task: TaskId, scene: Scene, cell: Volume | None = None, least: float = 0.0
) -> Path:
    """Writes the model in the checkpoint of a task as a PLY, and returns its path.

    Args: scene of the run; cell, of which alone the Gaussians are kept, without sky; least opacity of these.
    Raises OSError or RunError if that fails.
    """
    path, saved = folder.early(task), SavedModel(folder.checkpoint(task))

    def parts() -> Iterator[Gaussians]:
        for piece in saved.pieces():
            yield piece if cell is None else retained(piece, cell, least)

    count = sum(map(len, parts()))
    sky = saved.sky if cell is None else 0
    write_ply_parts(path, parts(), count=count, sky=sky, offset=scene.offset, exact=saved.exact)
    return path


def copy_coarse(folder: RunFolder) -> Merged:
    """Without refinement the Stage I model is the final one. Raises OSError if it cannot be written."""
    started = time.monotonic()
    source = folder.model(COARSE)
    count, sky = ply_header(source)
    rows, offset, exact = [(source, range(count))], ply_offset(source), ply_exact(source)
    join_ply(folder.point_cloud, rows, sky=sky, offset=offset, exact=exact)
    return _merged(folder, started)


def _block_plys(folder: RunFolder, state: RunState, plan: Plan, early: Early | None = None) -> list[Path]:
    """The files of all blocks that have Gaussians; made from Stage I for those not trained, or in vain."""
    blocks: list[int] = np.flatnonzero(plan.gaussians).tolist()
    found = {block: _trained_ply(folder, state, plan, block, early) for block in blocks}
    _keep_coarse(folder, plan, [block for block, path in found.items() if path is None])
    return [path or folder.kept(block) for block, path in found.items()]


def _trained_ply(
    folder: RunFolder, state: RunState, plan: Plan, block: int, early: Early | None
) -> Path | None:
    """The latest file of a block; None if it keeps Stage I."""
    for task in (TaskId.round(block), TaskId.block(block)):
        if state.status(task) == Status.DONE:
            return folder.model(task)
    if early is not None and early.uses(folder, state, task):
        return write_saved(folder, task, early.scene, plan.cell(block), early.least)
    return None


def _keep_coarse(folder: RunFolder, plan: Plan, blocks: Sequence[int]) -> None:
    """Writes what the Stage I model has in the cells of some blocks, after one look at all of it.

    Raises RunError if a Gaussian has a position that is not finite.
    """
    if not blocks:
        return
    coarse = folder.model(COARSE)
    labels = np.concatenate([_labels(piece, plan) for piece in read_ply_chunks(coarse)])
    offset, exact = ply_offset(coarse), ply_exact(coarse)
    for block in blocks:
        path = folder.kept(block)
        folder.make(path.parent)
        join_ply(path, [(coarse, labels == block)], sky=0, offset=offset, exact=exact)


def _labels(piece: Gaussians, plan: Plan) -> NDArray[np.int64]:
    """(N,) the block of each Gaussian; -1 for what no block keeps: sky, and what is fully transparent."""
    labels = np.full(len(piece), -1)
    seen = (piece.opacities[piece.scene] > -math.inf).numpy()
    try:
        blocks = plan.grid.block_of(contract(piece.means[piece.scene].numpy(), plan.aabb))
    except ValueError as error:
        raise RunError(f"the Stage I model cannot be cut: {error}") from error
    labels[piece.scene] = np.where(seen, blocks, -1)
    return labels


def _saved(folder: RunFolder, task: TaskId, count: int, iterations: int, started: float) -> ModelSaved:
    output = folder.model(task)
    size, seconds = output.stat().st_size, time.monotonic() - started
    return ModelSaved(task, folder.relative(output), count, size, iterations, seconds)


def _merged(folder: RunFolder, started: float) -> Merged:
    count, sky = ply_header(folder.point_cloud)
    size = folder.point_cloud.stat().st_size
    return Merged(folder.relative(folder.point_cloud), count, sky, size, time.monotonic() - started)
