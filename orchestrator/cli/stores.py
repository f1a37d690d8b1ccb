"""Runs whose folder is the URL of an object store, for the commands that take one: docs/storage.md."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from panolog.orchestrator.cli.console import progress_bar, say
from panolog.scene.errors import InputError
from panolog.scene.stores.url import is_url, parse_url


@contextmanager
def mirrored(
    run: str, local: Path | None, *, resumes: bool = False, force: bool = False, mirror: bool = True
) -> Iterator[Path]:
    """The folder on this machine of a run, which is copied to its store while the context lasts, and after.

    Args: run, a folder or a URL; local, the folder that `--local` names; resumes, whether the run exists;
    force, take it from another driver; mirror, false if another process copies it.
    Raises as `settings_of` and `mirror_process.mirrored`.
    """
    if not mirror or not (is_url(run) or resumes or local):  # as most runs: nothing of stores is imported
        yield Path(run)
        return
    from panolog.orchestrator.runs.storage.mirror_process import mirrored as kept
    from panolog.orchestrator.runs.storage.mirror_settings import settings_of

    settings = settings_of(run, local, os.environ, resumes=resumes, force=force)
    with kept(settings, say):
        yield settings.root if settings else Path(run)


@contextmanager
def opened(run: str, reader: Literal["status", "events", "report", "export"]) -> Iterator[tuple[Path, bool]]:
    """A run, or as much of it as a command reads, in a folder; and whether a driver elsewhere has it.

    Args: run, a folder or a URL. Raises StoreError if there is no such run or no access, StoreLostError; an
    InputError that is raised in the context names the URL in place of the folder.
    """
    if not is_url(run):
        yield Path(run), False
        return
    url = parse_url(run)
    from panolog.orchestrator.runs.storage import fetch

    wanted = {"report": fetch.for_report, "export": fetch.for_export}.get(reader, fetch.for_status)
    with progress_bar(f"reading {url}") as _, fetch.viewed(url, wanted) as found:
        try:
            yield found
        except InputError as error:  # about a file of the copy, which is gone when this is read
            raise type(error)(str(error).replace(str(found[0]), str(url))) from error
