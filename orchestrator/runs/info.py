"""run.json: what a run is of, with which settings, made by what; and which folder may become a run."""

import json
import os
import platform
import shutil
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from panolog.orchestrator.runs.config import RESOLVED, RunConfig
from panolog.orchestrator.runs.database import read_milestones
from panolog.orchestrator.runs.folder import RunFolder, command_line, flat, read_json, write_json
from panolog.orchestrator.runs.records import PreflightSaved, RunBegan, Stored
from panolog.orchestrator.runs.sql import WAYS_OUT
from panolog.orchestrator.runs.state import replay
from panolog.scene.errors import ConfigError, RunFolderError, wrong_value
from panolog.scene.files import SUFFIX
from panolog.scene.model import NO_OFFSET, Vector
from panolog.workers.tasks import COARSE
from panolog.workers.training.recipes import RECIPES

_PACKAGES = ("panolog", "torch", "ray", "numpy", "pycolmap")
_ROOT = Path(__file__).parents[2]  # of the package, or of its checkout
_SUFFIXES = (".py", ".cpp", ".h", ".cu", ".cuh")  # of sources
PENDING = ""  # fingerprint of a scene that the run has still to make
_FORERUNNERS = ("lock", "prepare", "store")  # what a driver or its mirror makes before run.json


class SceneRef(BaseModel):
    """Which scene a run belongs to."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str
    fingerprint: str  # `Scene.fingerprint`, or PENDING
    offset: Vector = NO_OFFSET  # `Scene.offset`: added to the run's coordinates, they are the scene's


class RunInfo(BaseModel):
    """run.json: written when a run begins, and once more when its preflight has resolved the settings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    scene: SceneRef
    config: RunConfig  # after the preflight: width, device and blocks are what the run uses
    seed: int
    versions: dict[str, str]
    created: str  # UTC, ISO 8601
    given: tuple[str, ...] | None = None  # settings that the user gave, by dotted key; None: not recorded


def check_output(root: Path, fingerprint: str) -> None:
    """Makes sure that a new run may be written to `root`; changes nothing.

    What a driver has left that was killed during its preflight is no run yet. Raises InputError if `root`
    holds a run (of this scene or of another), anything else, or cannot be written.
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
        if _unprepared(folder):
            return
        if read_info(folder).scene.fingerprint != fingerprint:
            raise RunFolderError(f"{folder.root}: belongs to a run of another scene; choose another folder")
        raise RunFolderError(
            f"{folder.root}: holds a run of this scene; use `{command_line('resume', folder.root)}`"
        )
    outline = (folder.outline.parent.name,) if folder.lock.exists() else ()  # else it is not a driver's
    for entry in folder.root.iterdir():
        if entry.name not in (*_FORERUNNERS, *outline) and not entry.name.endswith(SUFFIX):
            raise RunFolderError(f"{folder.root}: is not empty and not a run; choose another output folder")


def check_unprepared(folder: RunFolder) -> None:
    """Raises RunFolderError if a run is past its preflight."""
    if folder.info.exists() and not _unprepared(folder):
        raise RunFolderError(f"{folder.root}: holds this run; use `{command_line('resume', folder.root)}`")


def read_history(folder: RunFolder) -> list[Stored]:
    """The records of a run that `state.replay` needs; none before its first driver has begun.

    Raises InputError as `read_milestones` and `require_history`.
    """
    records = read_milestones(folder.database) if folder.database.exists() else []
    require_history(folder, empty=not records)
    return records


def require_history(folder: RunFolder, *, empty: bool) -> None:
    """Raises RunFolderError if run.db is lost, or empty, of a run that has begun to train.

    A driver that took it for a new one would train again, over the files of what is finished.

    Args: empty, whether run.db has no record.
    """
    made = (folder.point_cloud, folder.of(COARSE), folder.preflight)
    there = [path for path in made if path.exists()] if empty else []
    if there:
        raise RunFolderError(
            f"{folder.database}: is missing or holds nothing, but the run has made"
            f" {folder.relative(there[0])}: {WAYS_OUT}"
        )


def _unprepared(folder: RunFolder) -> bool:
    """Whether a driver was killed, or has failed, before the end of the preflight."""
    state = replay(read_history(folder))
    return state.driver is not None and not state.prepared


def clear(folder: RunFolder, *, keep_info: bool = False) -> None:
    """Removes what a driver makes before and during its preflight, but for the lock, which it holds."""
    journal = folder.database.with_name(f"{folder.database.name}-journal")
    files = folder.preflight, folder.adjusted, folder.measured, folder.poses, folder.database
    for path in (*files, folder.presence, journal, *(() if keep_info else (folder.info,))):
        path.unlink(missing_ok=True)
    folders = folder.control, folder.sparse, folder.follower, folder.mirror.parent, folder.outline.parent
    for path in (*folders, folder.of(COARSE)):
        shutil.rmtree(path, ignore_errors=True)


def discard(folder: RunFolder, missing: Sequence[Path]) -> None:
    """Leaves the folder of a run that has not started as it was. Args: missing, what was not there."""
    clear(folder)
    folder.lock.unlink(missing_ok=True)
    with suppress(OSError):  # something else is there by now
        for path in missing:
            path.rmdir()


def make_info(scene: SceneRef, config: RunConfig, wanted: RunConfig | None = None) -> RunInfo:
    """The content of run.json of a new run. Args: wanted, the settings as the user gave them."""
    preset, given = RECIPES[config.recipe].items(), None
    if wanted is not None:
        values = flat(wanted.model_dump(mode="json", exclude_unset=True))
        given = tuple(key for key, value in values if (key, value) not in preset)
    created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return RunInfo(
        scene=scene,
        config=config,
        seed=config.seed,
        versions=installed_versions(),
        created=created,
        given=given,
    )


def installed_versions() -> dict[str, str]:
    """The versions of Python and of the packages that a result may depend on."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):  # a run in a pool of local processes needs no Ray
            versions[name] = version(name)
    return versions


def write_info(folder: RunFolder, info: RunInfo) -> None:
    """Writes run.json, which makes the folder a run."""
    write_json(folder.info, info.model_dump(mode="json"))


def read_info(folder: RunFolder) -> RunInfo:
    """The content of run.json. Raises InputError if the folder is no run or the file is of another format."""
    try:
        return RunInfo.model_validate(read_json(folder), context=RESOLVED)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise RunFolderError(
            f"{folder.info}: is not of this PanoLOG's format: {key}: {wrong_value(first)}"
        ) from error


def changes(folder: RunFolder, config: RunConfig, records: Iterable[Stored], *, accept: bool) -> list[str]:
    """What of the settings is not as drivers have recorded it, such as "iterations = 300, not 200".

    Raises ConfigError if there is something and it is not accepted.
    """
    kept = [item.record for item in records if isinstance(item.record, RunBegan | PreflightSaved)]
    recorded = next((record.settings for record in reversed(kept) if record.settings), None)
    if recorded is None:  # by a version that recorded none
        return []
    with suppress(ValidationError):  # by today's names
        recorded = RunConfig.model_validate(recorded, context=RESOLVED).model_dump(mode="json")
    before, now = dict(flat(recorded)), dict(flat(config.model_dump(mode="json")))
    found = [
        f"{key} = {json.dumps(now.get(key))}, not {json.dumps(before.get(key))}"
        for key in before | now
        if before.get(key) != now.get(key)
    ]
    if found and not accept:
        raise ConfigError(
            f"{folder.info}: {'; '.join(found)}: not as the run was begun, so that parts of it would differ;"
            " undo that, or resume with --accept-changes"
        )
    return found


@cache
def own_code() -> str:
    """The fingerprint of what workers run, of the version that this process has started with."""
    return fingerprint(("scene", "renderer", "partition", "workers"))


def fingerprint(packages: Sequence[str], root: Path = _ROOT) -> str:
    """Twelve hexadecimal digits for the sources of some packages, as they are on disk.

    Args: root, the folder that has the packages.
    """
    digest = sha256()
    for package in packages:
        folder = (root / package).resolve()
        for path in sorted(path for path in folder.rglob("*") if path.suffix in _SUFFIXES):
            digest.update(f"{package}/{path.relative_to(folder)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
