"""What can be removed of a run folder, by kind, with its bytes. Reads only.

Leftovers of killed writers, checkpoints of tasks that are done or beyond those to keep, shards of a run that
is done; on request also the models of its parts, whose Gaussians the merged model has. The last checkpoint of
a task that is not done, the Stage I model and all results stay.
"""

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder, part_of, read_json
from panolog.orchestrator.runs.info import read_history
from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.runs.state import RunState, Status, TaskState, replay
from panolog.scene.files import SUFFIX
from panolog.scene.stores.url import StoreUrl
from panolog.workers.tasks import Stage, StrEnum, TaskId

_WRITING_S = 3_600.0  # without a write after which a writer, such as an export into the folder, is dead
_PARTS = (Stage.DISTRICT, Stage.BLOCK, Stage.ROUND, Stage.REPAIR, Stage.UNION)  # what the merged model has


class Kind(StrEnum):
    """Why something may be removed."""

    LEFTOVERS = "leftovers"  # of writers that were killed
    CHECKPOINTS = "checkpoints"  # of tasks that are done, or earlier ones
    SHARDS = "shards"  # of scores and of the evaluation, once they are joined
    VERSIONS = "versions"  # of files in a store, which none of its last manifests names
    MODELS = "models"  # of blocks, districts, rounds, repairs and unions, once they are merged


@dataclass(frozen=True)
class Wanted:
    """What a user wants to have removed."""

    checkpoints: int | None = None  # of a task that stay, the last one included; None = as the run's settings
    models: bool = False  # those of parts too
    older: float | None = None  # seconds since a run's last record from which on it is looked at; None = any


@dataclass(frozen=True)
class Removal:
    """A file or a folder that may be removed."""

    kind: Kind
    path: Path | PurePosixPath  # the latter in a store, below the URL
    size: int  # bytes
    task: TaskId | None = None  # whose model it is


@dataclass(frozen=True)
class Survey:
    root: Path | StoreUrl
    removals: tuple[Removal, ...] = ()
    skipped: str = ""  # why the run is left as it is
    failed: bool = False  # because of an error

    @property
    def sizes(self) -> dict[Kind, int]:
        """Bytes by kind, of those that there are."""
        kinds = dict.fromkeys((removal.kind for removal in self.removals), 0)
        for removal in self.removals:
            kinds[removal.kind] += removal.size
        return kinds


def survey(root: Path, wanted: Wanted, now: float, *, ours: bool = False) -> Survey:
    """What may be removed of a run, unless a driver is at work on it or it is too young.

    Args: now, seconds since the epoch; ours, the caller has the run's lock.
    Raises RunFolderError if it is no run or cannot be read.
    """
    folder = RunFolder(root)
    info = read_json(folder)
    if not ours and lock.held(folder.lock):
        return Survey(root, skipped="a driver is at work on it")
    keep = _kept(info) if wanted.checkpoints is None else wanted.checkpoints
    state = replay(read_history(folder))
    latest = state.latest if state.latest is not None else folder.info.stat().st_mtime
    if wanted.older is not None and now - latest < wanted.older:
        return Survey(folder.root, skipped=f"its last record is {(now - latest) / 86_400:.1f} days old")
    removals = [*_leftovers(folder.root, now), *_checkpoints(folder, state, keep)]
    if state.outcome == Outcome.DONE:
        removals += _shards(folder, state)
        removals += models_of_parts(folder, state) if wanted.models else ()
    return Survey(folder.root, tuple(removals))


def models_of_parts(folder: RunFolder, state: RunState) -> list[Removal]:
    """The models whose Gaussians the merged model has; none unless the run is done."""
    if state.outcome != Outcome.DONE or state.merged is None or not folder.point_cloud.is_file():
        return []
    found: list[Removal] = []
    for id in state.tasks:
        if id.stage in _PARTS:
            paths = (folder.model(id), folder.captured(id))
            found += [it for path in paths for it in _file(folder, Kind.MODELS, path, id)]
    for block in state.plan or ():
        found += _file(folder, Kind.MODELS, folder.kept(block.block), TaskId.block(block.block))
    return found


def _kept(info: dict[str, Any]) -> int:
    """How many checkpoints of a task the settings of a run keep; older runs have no such setting."""
    kept = part_of(part_of(info, "config"), "retention").get("checkpoints")
    return kept if isinstance(kept, int) and kept >= 1 else 1


def _checkpoints(folder: RunFolder, state: RunState, keep: int) -> Iterator[Removal]:
    for task in state.tasks.values():
        if task.id.stage.trains:
            for path in _superseded(folder, task, keep):
                yield from _file(folder, Kind.CHECKPOINTS, path)


def _superseded(folder: RunFolder, task: TaskState, keep: int) -> list[Path]:
    last, earlier = folder.checkpoint(task.id), folder.earlier_checkpoints(task.id)
    if task.status == Status.DONE:
        made = [folder.snapshot(task.id), *([folder.initial(task.id)] if task.id.stage.refines else [])]
        return [*earlier, last, *made]
    kept = keep - 1 if last.is_file() else keep  # never all that there is
    return earlier[: max(0, len(earlier) - kept)]


def _shards(folder: RunFolder, state: RunState) -> Iterator[Removal]:
    for id in state.tasks:
        if id.stage in (Stage.SCORE, Stage.MEASURE):
            for path in (folder.shard(id), folder.seen(id), folder.seen_coarse(id)):
                yield from _file(folder, Kind.SHARDS, path)


def _leftovers(root: Path, now: float) -> Iterator[Removal]:
    """What was being written under a temporary name, and no longer is. Links are not followed."""
    for place, folders, files in os.walk(root):
        partial = [name for name in (*folders, *files) if name.startswith(".") and name.endswith(SUFFIX)]
        folders[:] = [name for name in folders if name not in partial]
        for name in partial:
            path = Path(place, name)
            size, latest = _content(path)
            if now - latest > _WRITING_S and (path.is_dir() or path.is_file()) and not path.is_symlink():
                yield Removal(Kind.LEFTOVERS, path, size)


def _content(path: Path) -> tuple[int, float]:
    """Bytes of a file, or of all files in a folder, and when the latest was written in epoch seconds."""
    inside = (Path(place, name) for place, _, files in os.walk(path) for name in files)
    found = [it.lstat() for it in (path, *inside)]
    size = sum(status.st_size for status in found if not stat.S_ISDIR(status.st_mode))
    return size, max(status.st_mtime for status in found)


def _file(folder: RunFolder, kind: Kind, path: Path, task: TaskId | None = None) -> list[Removal]:
    """A plain file that really is below the run folder, whatever links are on the way; else nothing."""
    try:
        status = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return []
    below = path.parent.resolve().is_relative_to(folder.root.resolve())
    return [Removal(kind, path, status.st_size, task)] if below and stat.S_ISREG(status.st_mode) else []
