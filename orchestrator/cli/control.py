"""Requests to the driver of a live run (stop, pause, unpause, retry, release), and `clean`."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from panolog.orchestrator.cli.console import command, print_result, progress_bar, say
from panolog.orchestrator.cli.options import BlockArg, JsonOption, RunArg
from panolog.orchestrator.cli.syntax import argument, flag, option
from panolog.scene.errors import ConfigError, RunFolderError
from panolog.scene.stores.url import is_url, parse_url

if TYPE_CHECKING:
    from panolog.orchestrator.runs.retention.clean import Cleaned

_POLL = 0.5  # seconds between two looks at a driver that stops


def stop(run: RunArg) -> None:
    """Stop a run as Ctrl-C does; returns when its checkpoints are written."""
    from panolog.orchestrator.runs import control
    from panolog.orchestrator.runs.folder import RunFolder

    _request(run, "stop")
    folder = RunFolder(run)
    with progress_bar("waiting until the checkpoints are written"):
        while control.at_work(folder):
            time.sleep(_POLL)
    say(f"stopped; {command('resume', run)} resumes it")


def pause(run: RunArg, block: BlockArg) -> None:
    """Pause a block after its next checkpoint."""
    _request(run, "pause", block)
    say(f"requested; {command('unpause', run, block)} resumes the block")


def unpause(run: RunArg, block: BlockArg) -> None:
    """Resume a paused block."""
    _request(run, "unpause", block)
    say("requested; the block resumes when a worker is free")


def retry(run: RunArg, block: BlockArg) -> None:
    """Try a failed block again, with a full number of attempts."""
    _request(run, "retry", block)
    say("requested; the block starts when a worker is free")


def release(
    run: RunArg,
    node: Annotated[str, argument("NODE", "Its name in status, such as a host, or the begin of its id.")],
) -> None:
    """Use a machine or a GPU in quarantine again."""
    _request(run, "release", node=node)
    say("requested; the machine gets the next task that waits")


def _request(run: Path, action: str, block: int | None = None, node: str | None = None) -> None:
    """Sends a request to the driver. Raises InputError if no driver runs or the state does not allow it."""
    from panolog.orchestrator.runs import control
    from panolog.orchestrator.runs.database import read_milestones
    from panolog.orchestrator.runs.folder import RunFolder, read_head
    from panolog.orchestrator.runs.state import replay
    from panolog.scene.errors import InputError

    folder, wanted = RunFolder(run), control.request(action, block, node)
    read_head(folder)
    if (why := control.allowed(folder)) is not None:
        raise InputError(f"{run}: {why}")
    if (why := control.refusal(replay(read_milestones(folder.database)), wanted)) is not None:
        raise InputError(f"{run}: {wanted}: {why}")
    control.send(folder, action, block, node)


def clean(
    folders: Annotated[
        list[str], argument("RUN|FOLDER|URL", "Runs, folders with runs below them, or runs in stores.")
    ],
    keep_checkpoints: Annotated[
        int | None,
        option(
            "N", "Checkpoints that stay of a task that is not done. Default: as in the run's settings.", min=1
        ),
    ] = None,
    blocks: Annotated[
        bool,
        flag(
            "Also remove the models of blocks and other parts of runs that are done: the merged model"
            " has their Gaussians.",
            "--blocks",
        ),
    ] = False,
    older_than: Annotated[
        str | None, option("30d", "Only runs whose last record is older, such as 12h, 30d or 8w.")
    ] = None,
    keep_manifests: Annotated[
        int, option("K", "URL: the last K states of the run that stay whole, some seconds apart.", min=1)
    ] = 10,
    yes: Annotated[bool, flag("URL: confirm that what is listed is removed.", "--yes")] = False,
    dry_run: Annotated[
        bool, flag("Say what would be removed, with its bytes; remove nothing.", "--dry-run")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Remove what is superseded: leftovers, checkpoints of tasks that are done, joined shards.

    Of a run in a store: versions of files that its last states do not have. What that is is listed first.
    """
    from panolog.orchestrator.runs.retention.clean import age, clean
    from panolog.orchestrator.runs.retention.survey import Wanted

    wanted = Wanted(keep_checkpoints, blocks, None if older_than is None else age(older_than))
    if any(map(is_url, folders)):
        if keep_checkpoints is not None or blocks or not all(map(is_url, folders)):
            raise ConfigError("clean URL: takes no folders, --blocks and --keep-checkpoints; leave them out")
        _clean_stores(folders, keep_manifests, wanted.older, yes=yes, dry=dry_run, as_json=as_json)
    else:
        _say_cleaned(clean(_runs_in(folders), wanted, dry=dry_run), as_json=as_json)


def _runs_in(folders: list[str]) -> list[Path]:
    """The runs that these are, or have below them. Raises RunFolderError if one has none."""
    from panolog.orchestrator.watch.dashboard.discovery import discover

    roots: dict[Path, None] = {}
    for folder in map(Path, folders):
        found = discover(folder.resolve())
        if not found:
            raise RunFolderError(f"{folder}: is no run, and there is none below it")
        roots |= dict.fromkeys(folder / entry.path for entry in found.values())
    return list(roots)


def _clean_stores(
    urls: list[str], keep: int, older: float | None, *, yes: bool, dry: bool, as_json: bool
) -> None:
    """Lists what may be removed of runs in stores, and removes it if that is confirmed."""
    from panolog.orchestrator.runs.retention.stores import clean_stores, survey_stores

    with progress_bar("reading the stores"):
        found = survey_stores([parse_url(url) for url in urls], keep, older)
    if not (dry or yes) and any(run.removals for run in found.runs):
        for line in found.lines():
            say(line)
        if not sys.stdin.isatty():
            raise ConfigError("clean URL: nothing is removed without --yes where it cannot be confirmed")
        yes = typer.confirm("remove it?", err=True)
    if yes and not dry:
        with progress_bar("removing"):
            found = clean_stores(found, keep)
    _say_cleaned(found, as_json=as_json)


def _say_cleaned(cleaned: "Cleaned", *, as_json: bool) -> None:
    print_result(cleaned.as_json(), cleaned.lines(), as_json=as_json)
    if cleaned.failed:
        raise typer.Exit(2)
