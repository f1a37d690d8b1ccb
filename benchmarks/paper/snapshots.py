"""Quality over seconds: the states of one run on its way, evaluated after it has ended.

A run writes checkpoints anyway. While it trains, each new one gets a second name by a hard link, which copies
nothing and so takes no time from the run; after its end each is evaluated as the merged model that it would
have given. All states are of one run, since schedules depend on the number of iterations. Directly after a
reset of opacities a state is worse than the model that it becomes, and the curve shows it.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
from shutil import rmtree

import torch

from benchmarks.paper.measure import Gallery
from benchmarks.paper.results import Point
from benchmarks.paper.variants import POINTS
from benchmarks.runs import clock, history
from panolog.orchestrator.runs.clock import repeated
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import CheckpointSaved, ModelSaved
from panolog.partition.plan import Plan, read_plan
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.ply import read_ply
from panolog.workers.merge import retained
from panolog.workers.tasks import COARSE, Stage, TaskId
from panolog.workers.training.checkpoint import load, name_of
from panolog.workers.training.optimizer import ModelState

_INTERVAL = 0.1  # seconds between two looks for new checkpoints; each look is a few calls of stat


@dataclass(frozen=True)
class State:
    """A state of a task that was kept."""

    seconds: float  # of the run
    task: TaskId
    path: Path  # a checkpoint, or the model that the task ended with


@contextmanager
def kept(root: Path, folder: Path, *, wanted: bool = True) -> Iterator[None]:
    """Keeps each checkpoint that appears in the run `root` under a name of its own in `folder`, if wanted."""
    if not wanted:
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with repeated(partial(look, root, folder), _INTERVAL):
            yield
    finally:
        look(root, folder)


def look(root: Path, folder: Path) -> None:
    """Links the checkpoints that are in the run now, unless they are kept already."""
    paths = [*root.glob("coarse/checkpoint.safetensors"), *root.glob("blocks/*/checkpoint.safetensors")]
    for path in paths:
        with suppress(FileNotFoundError, FileExistsError):  # its task has ended; it is kept already
            status = path.stat()
            os.link(path, folder / f"{status.st_ino}-{status.st_mtime_ns}.safetensors")


def curve(root: Path, folder: Path, gallery: Gallery, before: float) -> tuple[Point, ...]:
    """The quality of the states in `folder` of the finished run `root`; the folder is removed.

    Args: before, seconds that were spent on what the run has borrowed.
    Raises RunError if a checkpoint is damaged.
    """
    states = _states(root, folder)
    run = RunFolder(root)
    coarse = [state for state in states if state.task == COARSE]
    points = [_point(state.seconds, _model(state.path), gallery, "coarse") for state in coarse]
    blocks = [state for state in states if state.task.stage is Stage.BLOCK]
    if blocks:
        stage_one, plan = read_ply(run.model(COARSE)), read_plan(run.plan)
        for number in _even(len(blocks)):
            model = _assembled(stage_one, plan, blocks[: number + 1])
            points.append(_point(blocks[number].seconds, model, gallery, "block"))
    rmtree(folder)
    return tuple(Point(point.seconds + before, point.ws_psnr, point.stage) for point in points)


def _point(seconds: float, model: Gaussians, gallery: Gallery, stage: str) -> Point:
    return Point(seconds, gallery.quality(model)["ws_psnr"] or 0.0, stage)


def _states(root: Path, folder: Path) -> list[State]:
    """In the order of time; what an interrupted attempt did twice is there once."""
    files = {name_of(path): path for path in folder.iterdir()}
    records, run = history(root), RunFolder(root)
    passed = clock(records, start=False)
    states: dict[tuple[TaskId, int], State] = {}
    for item in records:
        record, seconds = item.record, passed.get(item.id)
        if seconds is None:  # borrowed
            continue
        if isinstance(record, CheckpointSaved) and (path := files.get((record.task, record.iteration))):
            states[record.task, record.iteration] = State(seconds, record.task, path)
        if isinstance(record, ModelSaved):
            states[record.task, record.iterations] = State(seconds, record.task, run.model(record.task))
    return sorted(states.values(), key=lambda state: state.seconds)


def _model(path: Path) -> Gaussians:
    """The Gaussians of a checkpoint or of a PLY."""
    if path.suffix == ".ply":
        return read_ply(path)
    return ModelState.from_tensors(load(path).tensors).gaussians


def _assembled(stage_one: Gaussians, plan: Plan, states: Sequence[State]) -> Gaussians:
    """What a merge would give: of each block its latest state, or its Stage I; the sky last (eq. 13)."""
    latest = {state.task.number: state.path for state in states}
    sky = torch.arange(len(stage_one)) >= stage_one.scene.stop
    parts = [stage_one.select(sky)]
    for block in reversed(range(plan.grid.count)):
        path = latest.get(block)
        cut = path is not None and path.suffix == ".ply"
        model = stage_one if path is None else _model(path)
        parts.append(model if cut else retained(model, plan.cell(block), 0.0))
    return reduce(lambda last, part: concatenate(part, last), parts)


def _even(count: int) -> list[int]:
    """Up to twice POINTS of `count` indices, evenly, the last among them."""
    most = min(count, 2 * POINTS)
    return sorted({round((step + 1) * count / most) - 1 for step in range(most)})
