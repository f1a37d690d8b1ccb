"""`panolog view` and `panolog report`: what a run has made, for people."""

import webbrowser
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated

import typer

from panolog.orchestrator.cli.app import RunArg, app, say
from panolog.scene.errors import InputError


@app.command()
def view(
    source: Annotated[Path, typer.Argument(metavar="RUN|PLY", help="Folder of a run, or a PLY.")],
    task: Annotated[
        str | None, typer.Option(metavar="coarse|block/003", help="This one's current model, not the run's.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.html", help="Write the page here; opens nothing."),
    ] = None,
    most: Annotated[
        int | None, typer.Option(min=1, help="Gaussians shown, those that cover most: 500,000 unless given.")
    ] = None,
) -> None:
    """A model in 3D, in the browser: of a run as it stands, of one of its blocks, or of any PLY."""
    if not source.exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
    from panolog.orchestrator.run.folder import RunFolder, read_head

    folder = RunFolder(source) if source.is_dir() else None
    if folder is not None:
        read_head(folder)
    elif task is not None:
        raise InputError("--task is of runs: give the folder of one")
    from panolog.orchestrator.views.model_page import MOST, write_page, write_run_page

    page = output or Path(mkdtemp(prefix="panolog-view-")) / "view.html"
    if folder is not None:
        shown = write_run_page(folder, task, page, most=most or MOST)
    else:
        shown = write_page(source, page, title=source.name, most=most or MOST)
    say(f"{len(shown):,} Gaussians in {page}")
    if output is None:
        webbrowser.open(page.as_uri())


@app.command()
def report(
    run: RunArg,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.html", help="Instead of RUN/report.html.")
    ] = None,
) -> None:
    """A run as it stands as one page, to look at or to send to somebody."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.views.report import write_report

    print(write_report(RunFolder(run), output))
