"""The command line. Scripts depend on it: 0 done, 1 the run failed, 2 wrong input, 130 interrupted.

What a command needs is imported when it runs, so that `--help` and `status` wait for neither torch nor Ray.
"""

import json
import time
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from panolog.scene.errors import InputError, PanologError

if TYPE_CHECKING:
    from rich.console import Console

_POLL = 0.5  # seconds between two looks at a live run


class ExitCodes(TyperGroup):
    """Turns errors that are meant for the user into one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        try:
            return super().invoke(ctx)
        except PanologError as error:
            _complain(" ".join(str(error).split()))
            raise typer.Exit(2 if isinstance(error, InputError) else 1) from error
        except KeyboardInterrupt as error:
            _complain("interrupted; `panolog resume RUN` goes on with a run")
            raise typer.Exit(130) from error
        except BrokenPipeError as error:  # our output's reader has gone, as in `panolog events RUN | head`
            raise typer.Exit(0) from error
        except OSError as error:  # a file or folder that the user named cannot be read or written
            where = "" if error.filename is None else f"{error.filename}: "
            _complain(f"{where}{error.strerror or error}")
            raise typer.Exit(2) from error


app = typer.Typer(
    cls=ExitCodes,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Posed 360° panoramas to one 3D Gaussian Splatting model.",
)

SceneArg = Annotated[Path, typer.Argument(metavar="SCENE", help="Folder of a COLMAP or Pano360 scene.")]
RunArg = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
AddressOption = Annotated[
    str | None,
    typer.Option(metavar="auto|HOST:PORT", help="Run on this Ray cluster, not on this machine alone."),
]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Serve its page on this machine while it goes on.")
]
ConfigOption = Annotated[Path | None, typer.Option(metavar="F.yaml", help="Settings in YAML.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting; may be repeated.")
]
DeviceOption = Annotated[str | None, typer.Option(metavar="auto|cpu|cuda", help="Where to compute.")]
BlocksOption = Annotated[str | None, typer.Option(metavar="2x1x1|auto", help="Blocks along x, y and z.")]
IterationsOption = Annotated[int | None, typer.Option(metavar="N", help="Of Stage I and of each block.")]
WidthOption = Annotated[int | None, typer.Option(metavar="W", help="Of the panoramas, in pixels.")]


@app.command()
def run(
    scene: SceneArg,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN", help="Folder of the new run.")],
    config: ConfigOption = None,
    settings: SetOption = None,
    blocks: BlocksOption = None,
    iterations: IterationsOption = None,
    width: WidthOption = None,
    device: DeviceOption = None,
    address: AddressOption = None,
    dashboard: DashboardOption = False,
) -> None:
    """Reconstruct a scene: Stage I, partition, blocks, merge, evaluation."""
    from panolog.orchestrator.run.config import load_config

    flags = {"blocks": blocks, "iterations": iterations, "width": width, "device": device}
    resolved = load_config(config, settings or (), flags)
    from panolog.orchestrator.commands import session
    from panolog.orchestrator.views.progress import progress

    with _dashboard(output, wanted=dashboard), progress(err()) as show:
        state = session.start(scene, output, resolved, address, show)
    tell_end(output, state)


@app.command()
def resume(run: RunArg, address: AddressOption = None, dashboard: DashboardOption = False) -> None:
    """Go on with a run from its last checkpoints, whoever was killed."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))  # complain before torch is imported
    from panolog.orchestrator.commands import session
    from panolog.orchestrator.views.progress import progress

    with _dashboard(run, wanted=dashboard), progress(err()) as show:
        state = session.resume(run, address, show)
    tell_end(run, state)


@app.command()
def status(run: RunArg, as_json: JsonOption = False) -> None:
    """How a run stands: live, stopped or done. Reads the run folder only."""
    from panolog.orchestrator.run import lock
    from panolog.orchestrator.run.folder import RunFolder, read_head
    from panolog.orchestrator.run.state import replay
    from panolog.orchestrator.run.store import read_milestones

    folder = RunFolder(run)
    scene, width = read_head(folder)
    running = lock.held(folder.lock)
    state = replay(read_milestones(folder.database) if folder.database.exists() else ())
    if as_json:
        from panolog.orchestrator.views.summary import as_json as summary

        head = {"run": str(run), "scene": scene, "width": width}
        print_json(head | summary(state, running=running))
        return
    from rich import get_console

    from panolog.orchestrator.views.table import WIDE, table

    console = get_console()
    console.print(table(state, running=running, wide=console.width >= WIDE))


@app.command()
def events(
    run: RunArg,
    follow: Annotated[bool, typer.Option("--follow", help="Wait for more while the run goes on.")] = False,
) -> None:
    """The history of a run as JSON lines."""
    from panolog.orchestrator.run import lock
    from panolog.orchestrator.run.folder import RunFolder, read_head
    from panolog.orchestrator.run.records import as_line
    from panolog.orchestrator.run.store import read_records

    folder = RunFolder(run)
    read_head(folder)
    last = 0
    while True:
        live = lock.held(folder.lock)  # asked first: what a driver wrote before it ended is then read below
        while folder.database.exists() and (records := read_records(folder.database, after=last)):
            for stored in records:
                print(as_line(stored), flush=True)
            last = records[-1].id
        if not (follow and live):
            return
        time.sleep(_POLL)


def _dashboard(run: Path, *, wanted: bool) -> AbstractContextManager[Any]:
    from panolog.orchestrator.cli.dashboard import beside

    return beside(run) if wanted else nullcontext()


def tell_end(root: Path, state: Any) -> None:
    """Tells on stderr what a finished run has made and where."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.views.progress import metrics_line

    folder = RunFolder(root)
    say(f"model     {folder.point_cloud} ({state.merged.gaussians:,} Gaussians)")
    say(f"metrics   {folder.metrics} ({metrics_line(state.metrics or {})})")
    say(f"pictures  {folder.images}")
    if folder.plan_picture.exists():
        say(f"partition {folder.plan_picture}")
    if folder.report.exists():
        say(f"report    {folder.report}")


@cache
def err() -> "Console":
    """The console for people; Rich is imported when there is something to say."""
    from rich.console import Console

    return Console(stderr=True)


def say(line: str) -> None:
    """One line for people, on stderr."""
    err().print(line, highlight=False, markup=False, soft_wrap=True)


def print_json(content: dict[str, Any]) -> None:
    """The one JSON object on stdout."""
    print(json.dumps(content, indent=2, allow_nan=False))


def _complain(line: str) -> None:
    err().print(f"panolog: {line}", style="red", highlight=False, markup=False, soft_wrap=True)


def main() -> None:
    """The program."""
    from panolog.orchestrator.cli import (  # noqa: F401  # their commands register themselves
        cluster,
        control,
        dashboard,
        results,
        scene,
        tools,
    )

    app(prog_name="panolog")
