"""`panolog clean`: free disk of runs. Separate: found by the command's name."""

from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.console import print_result
from panolog.orchestrator.cli.options import JsonOption
from panolog.scene.errors import RunFolderError


def clean(
    folders: Annotated[
        list[Path], typer.Argument(metavar="RUN|FOLDER", help="Runs, or folders with runs below them.")
    ],
    keep_checkpoints: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Checkpoints that stay of a task that is not done. Default: as in the run's settings.",
        ),
    ] = None,
    blocks: Annotated[
        bool,
        typer.Option(
            "--blocks",
            help="Also remove the models of blocks and other parts of runs that are done: the merged model"
            " has their Gaussians.",
        ),
    ] = False,
    older_than: Annotated[
        str | None,
        typer.Option(metavar="30d", help="Only runs whose last record is older: hours, days or weeks."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be removed, with its bytes; remove nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Remove what is superseded: leftovers, checkpoints of tasks that are done, joined shards."""
    from panolog.orchestrator.dashboard.discovery import discover
    from panolog.orchestrator.retention.clean import age, clean
    from panolog.orchestrator.retention.survey import Wanted

    wanted = Wanted(keep_checkpoints, blocks, None if older_than is None else age(older_than))
    roots: dict[Path, None] = {}
    for folder in folders:
        found = discover(folder.resolve())
        if not found:
            raise RunFolderError(f"{folder}: is no run, and there is none below it")
        roots |= dict.fromkeys(folder / entry.path for entry in found.values())
    cleaned = clean(list(roots), wanted, dry=dry_run)
    print_result(cleaned.as_json(), cleaned.lines(), as_json=as_json)
    if cleaned.failed:
        raise typer.Exit(2)
