"""Where a run in a store is on this machine, and what its mirror gets: on stdin, without a secret."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from pydantic import TypeAdapter

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.storage.state import read_state
from panolog.orchestrator.runs.units import positive
from panolog.scene.errors import ConfigError
from panolog.scene.stores.cache import cache_folder
from panolog.scene.stores.store import require_package
from panolog.scene.stores.url import is_url, parse_url

PERIOD, PATIENCE = "PANOLOG_STORE_SECONDS", "PANOLOG_STORE_PATIENCE_MINUTES"
_PERIOD_S, _PATIENCE_MIN = 15.0, 30.0
_NUMBER = "a number above 0"


@dataclass(frozen=True)
class MirrorSettings:
    """What a mirror is to do."""

    root: Path  # the local folder
    url: str
    resumes: bool  # the run is there already, here or in the store
    force: bool = False  # take it from another driver
    again: bool = False  # the mirror of a driver that is at work was killed: this one takes its place
    period: float = _PERIOD_S  # seconds between two rounds
    patience: float = 60 * _PATIENCE_MIN  # seconds without progress after the run, before it gives up


MIRROR_SETTINGS = TypeAdapter(MirrorSettings)  # from and to the line of JSON that the mirror gets


def settings_of(
    run: str, local: Path | None, environment: Mapping[str, str], *, resumes: bool, force: bool = False
) -> MirrorSettings | None:
    """The settings for a run that the command line names; None if it is a folder that is in no store.

    Args: run, a URL, or a folder whose mirror has noted its URL; local, the folder that `--local` names.
    Raises StoreError if the URL or its package is not as it must be, ConfigError for options without a URL or
    wrong variables.
    """
    if is_url(run):
        url = parse_url(run)
        root = local.absolute() if local else local_folder(str(url), environment)
    else:
        if local is not None:
            raise ConfigError(f"--local {local}: only with the URL of a run; leave it out")
        root = Path(run)
        noted = read_state(RunFolder(root).mirror) if resumes else None
        if noted is None:
            if force:
                raise ConfigError("--force: only with the URL of a run; a local run has a lock")
            return None
        url = parse_url(noted.url)
    require_package(url)
    period = positive(PERIOD, environment, _PERIOD_S, _NUMBER)
    patience = 60 * positive(PATIENCE, environment, _PATIENCE_MIN, _NUMBER)
    return MirrorSettings(root, str(url), resumes, force, period=period, patience=patience)


def local_folder(url: str, environment: Mapping[str, str]) -> Path:
    """The folder on this machine of a run in a store: always the same for the same URL."""
    name = f"{parse_url(url).name[:40]}-{sha256(url.encode()).hexdigest()[:12]}"
    return cache_folder(environment).with_name("runs") / name


def shown(root: Path) -> str:
    """How commands name a run: by its URL if it is in a store."""
    noted = read_state(RunFolder(root).mirror)
    return noted.url if noted else os.fspath(root)
