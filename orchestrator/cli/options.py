"""Options and arguments that several commands share, each declared once."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from panolog.scene.errors import InputError

if TYPE_CHECKING:
    from panolog.orchestrator.run.config import RunConfig

SceneArg = Annotated[Path, typer.Argument(metavar="SCENE", help="Folder of a COLMAP or Pano360 scene.")]
RunArg = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
RunsArg = Annotated[list[Path], typer.Argument(metavar="RUN", help="Folders of two runs or more.")]
ModelArg = Annotated[Path, typer.Argument(metavar="RUN|PLY", help="Folder of a run, or a PLY file.")]
BlockArg = Annotated[int, typer.Argument(metavar="BLOCK", min=0, help="Number of a block.")]
NewRunOption = Annotated[Path, typer.Option("--output", "-o", metavar="RUN", help="Folder of the new run.")]
NewSceneOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="SCENE", help="Folder of the new scene.")
]
PageOption = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="FILE.html", help="Write the page to this file.")
]
PortOption = Annotated[
    int, typer.Option(metavar="PORT", min=0, max=65535, help="Port to serve on; 0 = any free port.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
LinkOption = Annotated[bool, typer.Option("--link", help="Link the panoramas instead of copying them.")]
AddressOption = Annotated[
    str | None, typer.Option(metavar="auto|HOST:PORT", help="Ray cluster to run on. Default: this machine.")
]
NiceOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=0,
        max=19,
        help="Yield to other processes: by how much workers on this machine are nicer. Default: 0.",
    ),
]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Serve the run's dashboard on this machine while it runs.")
]
SuperviseOption = Annotated[
    bool,
    typer.Option(
        "--supervise", help="Resume the run when its driver dies: killed, crashed, or its cluster was lost."
    ),
]
ResumesOption = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, help="With --supervise: resumes in a row without progress. Default: 10."
    ),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(metavar="auto|cpu|cuda", help="Device to compute on. Default: as in the settings, or auto."),
]
BlocksOption = Annotated[
    str | None,
    typer.Option(
        metavar="2x1x1|8|auto",
        help="Blocks along x, y and z; a number of balanced ones; or as many balanced ones as it takes.",
    ),
]
FrameOption = Annotated[
    str,
    typer.Option(
        metavar="export|model",
        help="Axes of FILE if it is no plain PLY: as `panolog export` writes it, or as the run's model.",
    ),
]
WidthOption = Annotated[
    int | None, typer.Option(metavar="W", help="Width of the panoramas in pixels. Default: as in the scene.")
]


def axes_of(frame: str) -> Literal["export", "model"]:
    """The value of `FrameOption`. Raises InputError for any other."""
    if frame not in ("export", "model"):
        raise InputError(f"--frame {frame}: write export or model")
    return "model" if frame == "model" else "export"


def _run_config(
    config: Annotated[Path | None, typer.Option(metavar="F.yaml", help="Settings, as a YAML file.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One setting; may be given several times."),
    ] = None,
    blocks: BlocksOption = None,
    iterations: Annotated[
        int | None,
        typer.Option(metavar="N", help="Iterations of Stage I and of each block. Default: 30,000."),
    ] = None,
    width: WidthOption = None,
    device: DeviceOption = None,
    memory: Annotated[
        str | None,
        typer.Option(metavar="GIB", help="Memory that a task may take; Gaussians grow to what fits."),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(metavar="paper|panolog", help="Preset of settings not given. Default: panolog."),
    ] = None,
) -> "RunConfig":
    """The options that set up a run, as its settings."""
    from panolog.orchestrator.run.config import load_config

    flags = {"blocks": blocks, "iterations": iterations, "width": width, "device": device}
    return load_config(config, settings or (), flags | {"memory": memory, "recipe": recipe})


def with_run_config(command: Callable[..., None]) -> Callable[..., None]:
    """Replaces the parameter `config` of a command by the options of `_run_config`, which make its value."""
    own, shared = inspect.signature(command).parameters, inspect.signature(_run_config).parameters

    @wraps(command)
    def wrapper(**options: Any) -> None:
        command(config=_run_config(**{name: options.pop(name) for name in shared}), **options)

    parameters = [
        new
        for name, parameter in own.items()
        for new in (shared.values() if name == "config" else (parameter,))
    ]
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # read by typer
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return wrapper
