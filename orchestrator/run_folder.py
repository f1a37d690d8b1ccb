"""The run folder: where everything of a run lies, what makes a folder one, and who may write to it."""

import json
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from panolog.orchestrator.config import RunConfig
from panolog.scene.errors import InputError
from panolog.scene.files import SUFFIX, write_bytes

_PACKAGES = ("panolog", "torch", "ray", "numpy", "pycolmap")
_FORERUNNER = "lock"  # what a driver makes before run.json


class SceneRef(BaseModel):
    """Which scene a run belongs to."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str
    fingerprint: str  # `Scene.fingerprint`


class RunInfo(BaseModel):
    """run.json: written once, never changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    scene: SceneRef
    config: RunConfig  # resolved: width and device are what the run uses
    seed: int
    versions: dict[str, str]
    created: str  # UTC, ISO 8601


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
    def lock(self) -> Path:
        """Held by the one driver."""
        return self.root / "lock"

    @property
    def plan(self) -> Path:
        """The partition."""
        return self.root / "partition" / "plan.json"

    @property
    def plan_picture(self) -> Path:
        """The partition from above."""
        return self.root / "partition" / "plan.png"

    @property
    def scores(self) -> Path:
        """All gradient scores (eq. 10): arrays `cameras` (K,) and `scores` (K, B)."""
        return self.root / "partition" / "scores.npz"

    @property
    def point_cloud(self) -> Path:
        """The merged model."""
        return self.root / "point_cloud.ply"

    @property
    def metrics(self) -> Path:
        """The metrics of the merged model."""
        return self.root / "eval" / "metrics.json"

    @property
    def images(self) -> Path:
        """Held-out renders beside the truth."""
        return self.root / "eval" / "images"

    def of(self, task: str) -> Path:
        """The folder of a training task: "coarse" → coarse, "block/007" → blocks/007."""
        return self.root / task.replace("block/", "blocks/")

    def checkpoint(self, task: str) -> Path:
        """The last checkpoint of a training task."""
        return self.of(task) / "checkpoint.safetensors"

    def model(self, task: str) -> Path:
        """What a training task ended with."""
        return self.of(task) / "model.ply"

    def kept(self, block: int) -> Path:
        """The Stage I Gaussians of a block that is not trained."""
        return self.root / "blocks" / f"{block:03d}" / "stage1.ply"

    def shard(self, task: str) -> Path:
        """The scores of one shard: "score/000" → partition/scores/000.npz."""
        return self.root / "partition" / "scores" / f"{task.removeprefix('score/')}.npz"

    def relative(self, path: Path) -> str:
        """How records name a path."""
        return path.relative_to(self.root).as_posix()


def check_output(root: Path, fingerprint: str) -> None:
    """Makes sure that a new run may be written to `root`; changes nothing.

    Raises InputError if it holds a run (of this scene or of another), anything else, or cannot be written.
    """
    if root.is_dir():
        _check_existing(RunFolder(root), fingerprint)
        place = root
    elif root.exists():
        raise InputError(f"{root}: is a file; choose another output folder")
    else:
        place = next(parent for parent in root.absolute().parents if parent.exists())
    if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"{root}: cannot be written, because {place} is not a folder that you may write to")


def make(root: Path) -> None:
    """Makes the folder of a run. Raises InputError if that is impossible."""
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{root}: cannot be made: {error.strerror}") from error


def _check_existing(folder: RunFolder, fingerprint: str) -> None:
    if folder.info.exists():
        if read_info(folder).scene.fingerprint != fingerprint:
            raise InputError(f"{folder.root}: belongs to a run of another scene; choose another folder")
        raise InputError(f"{folder.root}: holds a run of this scene; use `panolog resume {folder.root}`")
    for entry in folder.root.iterdir():
        if entry.name != _FORERUNNER and not entry.name.endswith(SUFFIX):
            raise InputError(f"{folder.root}: is not empty and not a run; choose another output folder")


def make_info(scene: SceneRef, config: RunConfig) -> RunInfo:
    """What run.json of a new run says."""
    versions = {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
    created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return RunInfo(scene=scene, config=config, seed=config.seed, versions=versions, created=created)


def write_info(folder: RunFolder, info: RunInfo) -> None:
    """Writes run.json, which makes the folder a run."""
    write_json(folder.info, info.model_dump(mode="json"))


def read_info(folder: RunFolder) -> RunInfo:
    """What run.json says. Raises InputError if the folder is no run or the file is not this version's."""
    try:
        return RunInfo.model_validate_json(folder.info.read_bytes())
    except FileNotFoundError as error:
        raise InputError(f"{folder.root}: is not a run folder, it has no run.json") from error
    except OSError as error:
        raise InputError(f"{folder.info}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(f"{folder.info}: is not of this PanoLOG's format: {key}: {first['msg']}") from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON object atomically, for people too; makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())
