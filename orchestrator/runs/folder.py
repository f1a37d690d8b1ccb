"""The run folder: where everything of a run lies. Imports little, so that looking at a run starts at once."""

import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from panolog.scene.errors import InputError, RunFolderError
from panolog.scene.files import stem_of, write_bytes
from panolog.workers.tasks import COARSE, Stage, TaskId

_RETENTION = 10_000_000  # bytes of retention.json at most: names of 100,000 tasks have two


@dataclass(frozen=True)
class RunFolder:
    """The paths of a run."""

    root: Path

    @property
    def info(self) -> Path:
        """run.json."""
        return self.root / "run.json"

    @property
    def database(self) -> Path:
        """run.db."""
        return self.root / "run.db"

    @property
    def preflight(self) -> Path:
        """What the run was expected to need."""
        return self.root / "preflight.json"

    @property
    def scene(self) -> Path:
        """The scene of a run that was given panoramas or a video."""
        return self.root / "scene"

    @property
    def preparation(self) -> Path:
        """How that scene is made: settings, progress, and what each step has come to."""
        return self.root / "prepare"

    @property
    def lock(self) -> Path:
        """Held by the one driver."""
        return self.root / "lock"

    @property
    def supervisor(self) -> Path:
        """What a supervisor has locked while it waits before a resume."""
        return self.root / "supervisor"

    @property
    def presence(self) -> Path:
        """What the live driver says without its database."""
        return self.root / "driver"

    @property
    def control(self) -> Path:
        """Requests of the user to the driver."""
        return self.root / "control"

    @property
    def follower(self) -> Path:
        """What of the run has been passed on, to each target and each sink."""
        return self.root / "follower"

    @property
    def retention(self) -> Path:
        """Which models were removed because the merged model stands for them."""
        return self.root / "retention.json"

    @property
    def mirror(self) -> Path:
        """How far the run has been copied to its object store; absent if it has none."""
        return self.root / "store" / "state.json"

    @property
    def report(self) -> Path:
        """The finished run as one page."""
        return self.root / "report.html"

    @property
    def plan(self) -> Path:
        """The partition."""
        return self.root / "partition" / "plan.json"

    @property
    def outline(self) -> Path:
        """The place before it is partitioned, as a plan of one block: cameras, and the box around them."""
        return self.root / "outline" / "plan.json"

    @property
    def outline_points(self) -> Path:
        """Some of the sparse points, PLY."""
        return self.root / "outline" / "points.ply"

    @property
    def known_plan(self) -> Path:
        """The partition, or before there is one the outline: perhaps neither is there."""
        return self.plan if self.plan.exists() else self.outline

    @property
    def plan_picture(self) -> Path:
        """The partition from above."""
        return self.root / "partition" / "plan.png"

    @property
    def scores(self) -> Path:
        """All gradient scores (eq. 10), sparse: see `partition.scores`."""
        return self.root / "partition" / "scores.npz"

    @property
    def point_cloud(self) -> Path:
        """The merged model."""
        return self.root / "point_cloud.ply"

    @property
    def sky(self) -> Path:
        """The sky of the merged model alone."""
        return self.root / "sky.ply"

    @property
    def web(self) -> Path:
        """The merged model for browsers: a page with its viewer, which any web server can serve."""
        return self.root / "web"

    @property
    def page(self) -> Path:
        """The merged model for browsers as one HTML file, which opens without a server."""
        return self.root / "view.html"

    @property
    def adjusted(self) -> Path:
        """Poses and points after bundle adjustment, and the poses before; absent if they stay."""
        return self.root / "adjusted.npz"

    @property
    def measured(self) -> Path:
        """How the panoramas were captured, as measured before Stage I; absent if that is not modelled."""
        return self.root / "capture.npz"

    @property
    def poses(self) -> Path:
        """How far cameras were moved by bundle adjustment and in Stage I."""
        return self.root / "poses.json"

    @property
    def sparse(self) -> Path:
        """The scene's COLMAP model with the poses that were refined."""
        return self.root / "sparse" / "0"

    @property
    def exposure(self) -> Path:
        """The exposure of each training panorama, as Stage I has learnt it."""
        return self.root / "exposure.json"

    @property
    def movers(self) -> Path:
        """What Stage I takes for movers: a mask STEM.png of each panorama that has some."""
        return self.root / "movers"

    @property
    def mover_shares(self) -> Path:
        """What part of each training panorama is covered by movers."""
        return self.root / "movers.json"

    @property
    def georeference(self) -> Path:
        """Where on the earth the merged model is, and what it was made of."""
        return self.root / "georef.json"

    @property
    def metrics(self) -> Path:
        """The metrics of the merged model."""
        return self.root / "eval" / "metrics.json"

    @property
    def images(self) -> Path:
        """Held-out renders above their photographs."""
        return self.root / "eval" / "images"

    @property
    def seams(self) -> Path:
        """What was measured at the faces between blocks."""
        return self.root / "eval" / "seams.json"

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
        """A training view as it was rendered at an iteration, above its photograph."""
        return self.previews(task) / f"{iteration:06d}.jpg"

    def checkpoint(self, task: TaskId) -> Path:
        """The last checkpoint of a training task."""
        return self.of(task) / "checkpoint.safetensors"

    def earlier_checkpoint(self, task: TaskId, iteration: int) -> Path:
        """One before the last, where the settings keep more than one."""
        return self.of(task) / f"checkpoint-{iteration:09d}.safetensors"

    def earlier_checkpoints(self, task: TaskId) -> list[Path]:
        """Those before the last, oldest first."""
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
        """The same of the Stage I model, which the seams of a merged model are compared with."""
        return self.shard(task).with_suffix(".coarse.ply")

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
    try:
        content = json.loads(folder.info.read_bytes())
    except FileNotFoundError as error:
        raise RunFolderError(f"{folder.root}: is not a run folder, it has no run.json") from error
    except OSError as error:
        raise RunFolderError(f"{folder.info}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise RunFolderError(f"{folder.info}: is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise RunFolderError(f"{folder.info}: is not of this PanoLOG's format: it holds no object")
    return content


def read_head(folder: RunFolder) -> tuple[str, int]:
    """The scene's path and the training width of a run. Raises InputError if the folder is no run."""
    return head_of(folder, read_json(folder))


def head_of(folder: RunFolder, content: dict[str, Any]) -> tuple[str, int]:
    """The same of the content of run.json."""
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


def removed_models(folder: RunFolder) -> frozenset[str]:
    """Tasks whose models were removed because the merged model stands for them; none if that is not noted."""
    try:
        handle = os.open(folder.retention, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return frozenset()
    try:
        content = json.loads(os.read(handle, _RETENTION))
    except (OSError, ValueError, RecursionError):
        return frozenset()
    finally:
        os.close(handle)
    names = content.get("removed_models") if isinstance(content, dict) else None
    return (
        frozenset(name for name in names if isinstance(name, str)) if isinstance(names, list) else frozenset()
    )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON object atomically, for people too; makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())
