"""The run folder: where everything of a run lies, and how a reader that need not trust it opens its files.

Imports little, so that looking at a run starts at once.
"""

import json
import os
import shlex
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from panolog.orchestrator.runs import lock
from panolog.scene.errors import InputError, RunFolderError
from panolog.scene.files import stem_of, write_bytes
from panolog.workers.tasks import COARSE, Stage, TaskId

T = TypeVar("T")
INFO_BYTES = 1_000_000  # of run.json at most
_RETENTION = 10_000_000  # bytes of retention.json at most: names of 100,000 tasks have two


class _At:
    """A path below the root of a run."""

    def __init__(self, below: str) -> None:
        self._below = below

    def __get__(self, folder: "RunFolder", _: object) -> Path:
        return folder.root / self._below


@dataclass(frozen=True)
class RunFolder:
    """The paths of a run."""

    root: Path

    info = _At("run.json")  # `info.RunInfo`
    database = _At("run.db")  # see `store`
    preflight = _At("preflight.json")  # what the run was expected to need
    scene = _At("scene")  # the scene of a run that was given panoramas or a video
    preparation = _At("prepare")  # how that scene is made: settings, progress, and what each step has come to
    preparation_settings = _At("prepare/settings.json")  # of what that scene is made, and how
    preparation_progress = _At("prepare/progress.json")  # what is done now
    masks_picture = _At("prepare/masks.jpg")  # some panoramas with their masks
    sfm_picture = _At("scene/sfm.png")  # the poses from above
    lock = _At("lock")  # held by the one driver
    supervisor = _At("supervisor")  # what a supervisor has locked while it waits before a resume
    presence = _At("driver")  # what the live driver says without its database
    control = _At("control")  # requests of the user to the driver
    follower = _At("follower")  # what of the run has been passed on, to each target and each sink
    retention = _At("retention.json")  # which models were removed because the merged model stands for them
    mirror = _At("store/state.json")  # how far the run has been copied to its store; absent without one
    report = _At("report.html")  # the finished run as one page
    plan = _At("partition/plan.json")  # the partition
    outline = _At("outline/plan.json")  # the place before it is partitioned, as a plan of one block
    outline_points = _At("outline/points.ply")  # some of the sparse points, PLY
    outline_fixes = _At("outline/gps.ply")  # where GPS has the panoramas, PLY: perhaps nothing
    plan_picture = _At("partition/plan.png")  # the partition from above
    scores = _At("partition/scores.npz")  # all gradient scores (eq. 10), sparse: see `partition.scores`
    point_cloud = _At("point_cloud.ply")  # the merged model
    sky = _At("sky.ply")  # the sky of the merged model alone
    web = _At("web")  # the merged model for browsers: a page with its viewer, which any web server can serve
    sog = _At("web/model.sog")  # that model as one file, which viewers open; absent if it is streamed
    page = _At("view.html")  # the merged model for browsers as one HTML file, which opens without a server
    adjusted = _At("adjusted.npz")  # poses before and after bundle adjustment, points; absent if they stay
    measured = _At("capture.npz")  # how panoramas were captured, before Stage I; absent if not modelled
    poses = _At("poses.json")  # how far cameras were moved by bundle adjustment and in Stage I
    sparse = _At("sparse/0")  # the scene's COLMAP model with the poses that were refined
    exposure = _At("exposure.json")  # the exposure of each training panorama, as Stage I has learnt it
    movers = _At("movers")  # what Stage I takes for movers: a mask STEM.png of each panorama that has some
    mover_shares = _At("movers.json")  # what part of each training panorama is covered by movers
    georeference = _At("georef.json")  # where on the earth the merged model is, and what it was made of
    metrics = _At("eval/metrics.json")  # the metrics of the merged model
    images = _At("eval/images")  # held-out renders above their photographs
    seams = _At("eval/seams.json")  # what was measured at the faces between blocks

    @property
    def place(self) -> Path:
        """The folder's absolute path, without `..`, so that it has a name."""
        return Path(os.path.normpath(self.root.absolute()))

    def make(self, place: Path) -> None:
        """Makes a folder below that of the run, with those between. Raises OSError.

        Never the run's own: where that is gone, as with a disk that is not mounted, another one in its place
        would take what the run writes, and keep the right one from coming back.
        """
        made = self.root
        for name in place.relative_to(self.root).parts:
            made /= name
            made.mkdir(exist_ok=True)

    @property
    def known_plan(self) -> Path:
        """The partition, or before there is one the outline: perhaps neither is there."""
        return self.plan if self.plan.exists() else self.outline

    def step_result(self, step: str) -> Path:
        """The result of a step of the preparation: there is one if the step is done."""
        return self.preparation / f"{step}.json"

    def seam(self, below: int, above: int) -> Path:
        """The folder of the pictures of a face between two blocks."""
        return self.root / "eval" / "seams" / f"{below:03d}-{above:03d}"

    def picture(self, view: str) -> Path:
        """The render of a held-out panorama above its photograph."""
        return self.images / f"{stem_of(view)}.jpg"

    def of(self, task: TaskId) -> Path:
        """The folder of a training task: coarse, or blocks/007."""
        if task.stage is Stage.BLOCK:
            return self.root / "blocks" / f"{task.number:03d}"
        return self.root / str(task)

    def previews(self, task: TaskId) -> Path:
        """The folder of the previews of a training task: see `preview`."""
        return self.of(task) / "previews"

    def preview(self, task: TaskId, iteration: int) -> Path:
        """A panorama as it was rendered at an iteration, above its photograph."""
        return self.previews(task) / f"{iteration:06d}.jpg"

    def checkpoint(self, task: TaskId) -> Path:
        """The last checkpoint of a training task."""
        return self.of(task) / "checkpoint.safetensors"

    def snapshot(self, task: TaskId) -> Path:
        """What a 3D view shows of the model of Stage I in training: see `shown_model`."""
        return self.of(task) / "snapshot.safetensors"

    def earlier_checkpoint(self, task: TaskId, iteration: int) -> Path:
        """One before the last, where the settings keep more than one."""
        return self.of(task) / f"checkpoint-{iteration:09d}.safetensors"

    def earlier_checkpoints(self, task: TaskId) -> list[Path]:
        """The checkpoints before the last, oldest first."""
        return sorted(self.of(task).glob("checkpoint-*.safetensors"))

    def model(self, task: TaskId) -> Path:
        """What a training task ended with."""
        return self.of(task) / "model.ply"

    def mover_mask(self, name: str) -> Path:
        """The movers of a panorama: 8 bit, 0 = one, as the masks of a scene."""
        return self.movers / f"{stem_of(name)}.png"

    def mover_picture(self, name: str) -> Path:
        """A panorama with its movers tinted; those with the largest have one."""
        return self.movers / "pictures" / f"{stem_of(name)}.jpg"

    def captured(self, task: TaskId) -> Path:
        """What a task of Stage I has learnt about how its panoramas were captured; absent if nothing."""
        return self.of(task) / "captured.npz"

    def initial(self, task: TaskId) -> Path:
        """What a task starts from, while it trains, where that is not the model of the whole place."""
        return self.of(task) / "initial.ply"

    def kept(self, block: int) -> Path:
        """The Stage I Gaussians of a block that is not trained."""
        return self.of(TaskId.block(block)) / "stage1.ply"

    def early(self, task: TaskId) -> Path:
        """The model in the last checkpoint of a task that a limit has ended."""
        return self.of(task) / "early.ply"

    def shard(self, task: TaskId) -> Path:
        """What one shard has come to: scores, or what an evaluation has measured."""
        if task.stage is Stage.MEASURE:
            return self.root / "eval" / "shards" / f"{task.number:03d}.json"
        return self.root / "partition" / "scores" / f"{task.number:03d}.npz"

    def seen(self, task: TaskId) -> Path:
        """The model that a shard renders, while it does, where that is reduced to what its cameras see."""
        return self.shard(task).with_suffix(".ply")

    def seen_coarse(self, task: TaskId) -> Path:
        """The Stage I model as a shard renders it, reduced as in `seen`, which seams are compared with."""
        return self.shard(task).with_suffix(".coarse.ply")

    def read(self, path: Path, most: int) -> bytes:
        """The bytes of one of its files, whatever the folder holds. Raises InputError as `read_below`."""
        return read_below(path, self.root, most)

    def parsed(self, path: Path, most: int, parse: Callable[[bytes], T], way: str) -> T:
        """What `parse` makes of one of its files. Args: way, what helps where the file is damaged.

        Raises InputError that names the file, and its folder, if it is damaged or `read` refuses it.
        """
        try:
            return parse(self.read(path, most))
        except InputError as error:
            raise RunFolderError(f"{path.parent}/{error}") from error
        except (ValueError, RecursionError) as error:
            json_error = f" (not JSON: {error})" if isinstance(error, json.JSONDecodeError) else ""
            raise RunFolderError(f"{path}: is damaged{json_error}; {way}") from error

    def relative(self, path: Path) -> str:
        """How records name a path."""
        return path.relative_to(self.root).as_posix()


def command_line(*words: object) -> str:
    """`panolog` with these words, as a shell on Linux takes it."""
    return shlex.join(["panolog", *map(str, words)])


def make(root: Path) -> list[Path]:
    """Makes the folder of a run. Returns the folders that were missing. Raises InputError if that fails."""
    missing = [folder for folder in (root, *root.parents) if not folder.exists()]
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{root}: cannot be created: {error.strerror}") from error
    return missing


def read_json(folder: RunFolder) -> dict[str, Any]:
    """The content of run.json, unchecked: `run_info.read_info` checks it.

    Raises InputError if the folder is no run or the file holds no JSON object.
    """
    if not folder.info.exists():
        raise RunFolderError(f"{folder.root}: is not a run folder, it has no run.json")
    try:
        content = json.loads(folder.read(folder.info, INFO_BYTES))
    except InputError as error:
        raise RunFolderError(f"{folder.root}/{error}") from error
    except ValueError as error:
        raise RunFolderError(f"{folder.info}: is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise RunFolderError(f"{folder.info}: is not of this PanoLOG's format: it holds no object")
    return content


def part_of(content: Mapping[str, Any], key: str) -> dict[str, Any]:
    """An object in a JSON object, such as the settings in run.json; {} if what is there is none."""
    found = content.get(key)
    return found if isinstance(found, dict) else {}


def read_head(folder: RunFolder) -> tuple[str, int]:
    """The scene's path and the training width of a run. Raises InputError if the folder is no run."""
    return head_of(folder, read_json(folder))


def head_of(folder: RunFolder, content: dict[str, Any]) -> tuple[str, int]:
    """The scene and the width of a run, by the content of run.json."""
    try:
        return content["scene"]["path"], content["config"]["width"]
    except (KeyError, TypeError) as error:
        raise RunFolderError(f"{folder.info}: is not of this PanoLOG's format: it names no scene") from error


def model_of(folder: RunFolder, task: TaskId | None = None) -> Path:
    """The file of the current model of a run, or of one of its training tasks: a PLY or a checkpoint.

    The run's is the merged model if there is one, else that of Stage I. Raises InputError if there is none.
    """
    if task is not None and not task.stage.trains:
        raise InputError(f"{task} is not a task that trains: write coarse or block/003")
    files = [folder.point_cloud] if task is None else []
    trained = task or COARSE
    files += [folder.model(trained), folder.checkpoint(trained)]
    for file in files:
        if file.is_file():
            return file
    if task is not None and str(task) in removed_models(folder):
        raise RunFolderError(
            f"{folder.root}: the model of {task} was removed after the merge; the merged model has its"
            " Gaussians"
        )
    raise RunFolderError(
        f"{folder.root}: {task or 'the run'} has no model yet; its first checkpoint makes one"
    )


def shown_model(folder: RunFolder, task: TaskId | None = None) -> Path:
    """The file of the model that a 3D view shows: `model_of`, or of Stage I in training its latest snapshot.

    A checkpoint counts in its place only once no driver is at work: in between it would have other details.
    Raises InputError as `model_of` does.
    """
    snapshot, last = folder.snapshot(COARSE), folder.checkpoint(COARSE)
    if task not in (None, COARSE) or not snapshot.is_file():
        return model_of(folder, task)
    try:
        file = model_of(folder, task)
    except RunFolderError:
        return snapshot
    superseded = last.is_file() and last.stat().st_mtime_ns > snapshot.stat().st_mtime_ns
    return snapshot if file == last and (lock.held(folder.lock) or not superseded) else file


def removed_models(folder: RunFolder) -> frozenset[str]:
    """Tasks whose models were removed because the merged model stands for them; none if that is not noted."""
    names = read_object(folder.retention, _RETENTION).get("removed_models")
    return frozenset(it for it in names if isinstance(it, str)) if isinstance(names, list) else frozenset()


def read_object(path: Path, most: int) -> dict[str, Any]:
    """The JSON object in a file that may be anything; {} if it is none, or no plain file.

    Args: most, bytes that are read.
    """
    try:
        content = json.loads(read_below(path, path.parent, most))
    except (OSError, InputError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of a JSON object by dotted key, such as the settings in run.json."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON object atomically, for people too. Raises OSError."""
    write_bytes(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def require_plain(folder: RunFolder) -> None:
    """Raises RunFolderError if what readers open by its path is a link or of another kind, and OSError."""
    files = (folder.info, folder.database, Path(f"{folder.database}-journal"), folder.lock, folder.presence)
    for path in filter(os.path.lexists, (*files, folder.control)):
        mode = path.lstat().st_mode
        if not (stat.S_ISDIR(mode) if path == folder.control else stat.S_ISREG(mode)):
            kind = "folder" if path == folder.control else "plain file"
            raise RunFolderError(f"{path}: is not a {kind}, so this is not the folder of a run")


def is_below(path: Path, *places: Path) -> bool:
    """Whether there is a file that really is below one of some folders, whatever links are on the way."""
    try:
        real = path.resolve()
        return path.is_file() and any(real.is_relative_to(place.resolve()) for place in places)
    except (OSError, ValueError):  # a name that no file can have
        return False


@contextmanager
def opened(path: Path, below: Path) -> Iterator[BinaryIO]:
    """A plain file to read, if it really is below a folder. Raises as `open_below`."""
    with os.fdopen(open_below(path, below), "rb") as file:
        yield file


def open_below(path: Path, below: Path) -> int:
    """A descriptor of a plain file that really is below a folder, whatever links are on the way.

    The path is checked after the file was opened, so that it cannot be exchanged in between.
    Raises InputError if there is no such file there.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path.name}: cannot be read: {why}") from error
    try:
        real = by_handle(handle).readlink()
        if not (stat.S_ISREG(os.fstat(handle).st_mode) and real.is_relative_to(below.resolve())):
            raise InputError(f"{path.name}: is not a plain file of the run")
    except (OSError, InputError):
        os.close(handle)
        raise
    return handle


def read_below(path: Path, below: Path, most: int) -> bytes:
    """The bytes of a plain file below a folder. Raises InputError as `open_below`, or beyond `most` bytes."""
    with opened(path, below) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise InputError(f"{path.name}: has more than {most:,} bytes")
    return content


def by_handle(handle: int) -> Path:
    """A path that opens the file of a descriptor again, whatever has its name by now."""
    return Path(f"/proc/self/fd/{handle}")
