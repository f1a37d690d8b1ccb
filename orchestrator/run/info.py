"""run.json: what a run is of, with which settings, made by what; and which folder may become a run."""

import os
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder, read_json, write_json
from panolog.scene.errors import RunFolderError
from panolog.scene.files import SUFFIX
from panolog.scene.model import NO_OFFSET, Vector

_PACKAGES = ("panolog", "torch", "ray", "numpy", "pycolmap")
_FORERUNNER = "lock"  # what a driver makes before run.json


class SceneRef(BaseModel):
    """Which scene a run belongs to."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str
    fingerprint: str  # `Scene.fingerprint`
    offset: Vector = NO_OFFSET  # `Scene.offset`: added to the run's coordinates, they are the scene's


class RunInfo(BaseModel):
    """run.json: written once, never changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    scene: SceneRef
    config: RunConfig  # resolved: width and device are what the run uses
    seed: int
    versions: dict[str, str]
    created: str  # UTC, ISO 8601


def check_output(root: Path, fingerprint: str) -> None:
    """Makes sure that a new run may be written to `root`; changes nothing.

    Raises InputError if it holds a run (of this scene or of another), anything else, or cannot be written.
    """
    if root.is_dir():
        _check_existing(RunFolder(root), fingerprint)
        place = root
    elif root.exists():
        raise RunFolderError(f"{root}: is a file; choose another output folder")
    else:
        place = next(parent for parent in root.absolute().parents if parent.exists())
    if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        raise RunFolderError(
            f"{root}: cannot be written, because {place} is not a folder that you may write to"
        )


def _check_existing(folder: RunFolder, fingerprint: str) -> None:
    if folder.info.exists():
        if read_info(folder).scene.fingerprint != fingerprint:
            raise RunFolderError(f"{folder.root}: belongs to a run of another scene; choose another folder")
        raise RunFolderError(f"{folder.root}: holds a run of this scene; use `panolog resume {folder.root}`")
    for entry in folder.root.iterdir():
        if entry.name != _FORERUNNER and not entry.name.endswith(SUFFIX):
            raise RunFolderError(f"{folder.root}: is not empty and not a run; choose another output folder")


def make_info(scene: SceneRef, config: RunConfig) -> RunInfo:
    """The content of run.json of a new run."""
    versions = {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
    created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return RunInfo(scene=scene, config=config, seed=config.seed, versions=versions, created=created)


def write_info(folder: RunFolder, info: RunInfo) -> None:
    """Writes run.json, which makes the folder a run."""
    write_json(folder.info, info.model_dump(mode="json"))


def read_info(folder: RunFolder) -> RunInfo:
    """The content of run.json. Raises InputError if the folder is no run or the file is of another format."""
    try:
        return RunInfo.model_validate(read_json(folder))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise RunFolderError(
            f"{folder.info}: is not of this PanoLOG's format: {key}: {first['msg']}"
        ) from error
