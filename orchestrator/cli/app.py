"""The program `panolog`. Its exit codes: 0 done, 1 the run failed, 2 wrong input, 130 interrupted.

Commands import what they need when they run, so that `--help` and `status` import neither torch nor Ray.
"""

import sys
from typing import Annotated, Any, TextIO, cast

import typer

from panolog.orchestrator.cli import (
    cluster,
    control,
    dashboard,
    export,
    notify,
    queue,
    results,
    run,
    scene,
)
from panolog.orchestrator.cli.console import Lasting, say
from panolog.orchestrator.cli.syntax import Command, Group, flag
from panolog.orchestrator.runs import log
from panolog.scene.errors import InputError, PanologError, explained, in_one_line


class ExitCodes(Group):
    """Turns the errors that are meant for the user into one line on stderr and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        try:
            return super().invoke(ctx)
        except PanologError as error:
            message, code = in_one_line(error), 2 if isinstance(error, InputError) else 1
        except ModuleNotFoundError as error:
            if (missing := explained(error)) is None:
                raise
            message, code = str(missing), 2
        except KeyboardInterrupt:
            message, code = "interrupted", 130
        except BrokenPipeError as error:  # the reader of stdout has gone, as in `panolog events RUN | head`
            raise typer.Exit(0) from error
        except OSError as error:  # a file or folder that the user named cannot be read or written
            where = "" if error.filename is None else f"{error.filename}: "
            message, code = f"{where}{error.strerror or error}", 2
        say(f"panolog: {message}", style="red")
        raise typer.Exit(code)


app = typer.Typer(
    cls=ExitCodes,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_PANELS: dict[str, dict[str, Any]] = {
    "First steps": {"demo": run.demo, "doctor": run.doctor, "models": scene.models},
    "Runs": {
        "run": run.run,
        "resume": run.resume,
        "status": run.status,
        "dashboard": dashboard.dashboard,
        "events": run.events,
    },
    "Control of a live run": {
        "stop": control.stop,
        "pause": control.pause,
        "unpause": control.unpause,
        "retry": control.retry,
        "release": control.release,
    },
    "Results": {
        "view": results.view,
        "export": export.export,
        "render": results.render,
        "report": results.report,
        "compare": results.compare,
        "eval": results.evaluate,
        "partition": results.partition,
        "clean": control.clean,
    },
}
for _panel, _commands in _PANELS.items():
    for _name, _command in _commands.items():
        app.command(_name, cls=Command, rich_help_panel=_panel)(_command)
app.add_typer(scene.app, name="scene", rich_help_panel="Scenes and clusters")
app.add_typer(queue.app, name="queue", rich_help_panel="Runs")
app.add_typer(notify.app, name="notify", rich_help_panel="Control of a live run")
app.add_typer(cluster.app, name="cluster", rich_help_panel="Scenes and clusters")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"panolog {version('panolog')}")
        raise typer.Exit


@app.callback()
def _program(
    _version: Annotated[
        bool, flag("Print the version.", "--version", callback=_print_version, is_eager=True)
    ] = False,
    verbose: Annotated[
        int,
        flag("Log to stderr: -v decisions, -vv details.", "--verbose", "-v", count=True, show_default=False),
    ] = 0,
) -> None:
    """Reconstruct places from 360° panoramas as one 3D Gaussian Splatting model."""
    log.configure(verbose)


def main() -> None:
    """Runs the program."""
    sys.stderr = cast(TextIO, Lasting(sys.stderr))
    app(prog_name="panolog")
