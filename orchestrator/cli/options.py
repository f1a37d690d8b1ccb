"""Options and arguments that several commands share, each declared once."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from panolog.scene.errors import InputError

if TYPE_CHECKING:
    from panolog.orchestrator.runs.config import RunConfig
    from panolog.orchestrator.runs.money.limits import Wanted
    from panolog.orchestrator.runs.preparation.settings import Options

# Panels of the help, besides that of the basic options.
_SETTINGS, _MACHINES, _TOLD = "Settings", "Machines and the driver", "Notifications and logs"
BUDGET = "Cost and time (docs/money.md)"
_MADE = "Panoramas or a video instead of a scene"

SceneArg = Annotated[Path, typer.Argument(metavar="SCENE", help="Folder of a COLMAP or Pano360 scene.")]
AnySceneArg = Annotated[
    str, typer.Argument(metavar="SCENE", help="Folder or URL of a COLMAP or Pano360 scene.")
]
SourceArg = Annotated[
    str,
    typer.Argument(
        metavar="SCENE|IMAGES|VIDEO",
        help="Scene (folder, s3://, gs://, az://), folder of panoramas, or 360° video.",
    ),
]
AnyRunArg = Annotated[str, typer.Argument(metavar="RUN", help="Folder or URL of a run.")]
RunArg = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
RunsArg = Annotated[list[Path], typer.Argument(metavar="RUN", help="Folders of two runs or more.")]
ModelArg = Annotated[Path, typer.Argument(metavar="RUN|PLY", help="Folder of a run, or a PLY file.")]
AnyModelArg = Annotated[str, typer.Argument(metavar="RUN|PLY", help="Folder or URL of a run, or a PLY file.")]
BlockArg = Annotated[int, typer.Argument(metavar="BLOCK", min=0, help="Number of a block.")]
NewRunOption = Annotated[
    str, typer.Option("--output", "-o", metavar="RUN", help="Folder or URL of the new run.")
]
LocalOption = Annotated[
    Path | None,
    typer.Option(
        "--local",
        metavar="DIR",
        help="Folder on this machine of a run with a URL. Default: in the cache.",
        rich_help_panel=_MACHINES,
    ),
]
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
    str | None,
    typer.Option(
        metavar="HOST:PORT|auto",
        help="Ray cluster to run on. Default: this machine.",
        rich_help_panel=_MACHINES,
    ),
]
NiceOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=0,
        max=19,
        help="Let other programs go first: 0 to 19. Default: 0.",
        rich_help_panel=_MACHINES,
    ),
]
DashboardOption = Annotated[
    bool,
    typer.Option("--dashboard", help="Show the run in the browser while it runs.", rich_help_panel=_MACHINES),
]
SuperviseOption = Annotated[
    bool,
    typer.Option(
        "--supervise",
        help="Resume the run when its driver is killed or crashes, or its cluster is lost.",
        rich_help_panel=_MACHINES,
    ),
]
ResumesOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        help="With --supervise: resumes in a row without progress. Default: 10.",
        rich_help_panel=_MACHINES,
    ),
]
NotifyOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND:URL",
        help="Notify by webhook, slack, ntfy or mail (docs/notifications.md); repeatable.",
        rich_help_panel=_TOLD,
    ),
]
LogOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SINK",
        help="Curves also to mlflow, tensorboard or wandb; repeatable.",
        rich_help_panel=_TOLD,
    ),
]
PricesOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        help="Prices of machines. Default: ~/.config/panolog/prices.toml.",
        rich_help_panel=BUDGET,
    ),
]
MaxCostOption = Annotated[
    str | None,
    typer.Option(
        metavar="AMOUNT|none",
        help="End the training before the run costs more, and deliver what there is.",
        rich_help_panel=BUDGET,
    ),
]
DeadlineOption = Annotated[
    str | None,
    typer.Option(
        metavar="6h|08:00|none",
        help="The same, so that all is done by then.",
        rich_help_panel=BUDGET,
    ),
]
AcceptOption = Annotated[
    bool,
    typer.Option(
        "--accept-changes",
        help="Go on with other settings in run.json than those that the run was begun with.",
    ),
]
AtEndOption = Annotated[
    str | None,
    typer.Option(
        "--at-end",
        metavar="COMMAND",
        help="Carried out when the run has ended for good, but not if it is stopped.",
        rich_help_panel=BUDGET,
    ),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(metavar="auto|cpu|cuda", help="Device to compute on. Default: auto."),
]
BlocksOption = Annotated[
    str | None,
    typer.Option(
        metavar="2x1x1|8|auto",
        help="Blocks along x, y, z; so many balanced ones; or as many as it takes.",
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
    int | None, typer.Option(metavar="W", help="Of the panoramas in pixels. Default: as they are.")
]

PairsOption = Annotated[
    Literal["auto", "exhaustive", "sequential"],
    typer.Option("--pairs", metavar="HOW", help="Pairs to match: auto, exhaustive or sequential."),
]
MapperOption = Annotated[
    Literal["incremental", "global"], typer.Option(metavar="HOW", help="Mapper: incremental or global.")
]
ParallaxOption = Annotated[
    float | None,
    typer.Option(
        metavar="DEGREES", help="Video: parallax between two frames. Default: 4.", rich_help_panel=_MADE
    ),
]
FramesOption = Annotated[
    int | None,
    typer.Option(metavar="N", min=2, help="Video: take at most N frames.", rich_help_panel=_MADE),
]
UpOption = Annotated[
    Literal["up", "right", "down", "left"] | None,
    typer.Option(
        metavar="up|right|down|left",
        help="Two lenses, not stitched: where up is in the first circle. Default: up.",
        rich_help_panel=_MADE,
    ),
]
DistanceOption = Annotated[
    tuple[str, str, float] | None,
    typer.Option(
        metavar="NAME NAME METRES",
        help="Distance between two of them; sets the scale.",
        rich_help_panel=_MADE,
    ),
]
TrajectoryOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Known trajectory, TUM or CSV (docs/sfm.md).",
        rich_help_panel=_MADE,
    ),
]
GpsOption = Annotated[
    bool,
    typer.Option(
        "--gps/--no-gps", help="Scale and north from GPS in EXIF.", show_default=False, rich_help_panel=_MADE
    ),
]
PartialOption = Annotated[
    bool,
    typer.Option(
        "--partial",
        help="Accept poses of half of the panoramas or fewer.",
        rich_help_panel=_MADE,
    ),
]


def wanted(prices: str | None, max_cost: str | None, deadline: str | None) -> "Wanted":
    """The values of these options. Raises ConfigError if one is wrong."""
    from panolog.orchestrator.runs.money.limits import Wanted
    from panolog.orchestrator.runs.money.prices import find_prices

    return Wanted.of(max_cost, deadline, find_prices(prices))


def axes_of(frame: str) -> Literal["export", "model"]:
    """The value of `FrameOption`. Raises InputError for any other."""
    if frame not in ("export", "model"):
        raise InputError(f"--frame {frame}: write export or model")
    return "model" if frame == "model" else "export"


def run_config(
    config: Annotated[
        Path | None, typer.Option(metavar="F.yaml", help="Settings in YAML.", rich_help_panel=_SETTINGS)
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="One setting; repeatable.", rich_help_panel=_SETTINGS
        ),
    ] = None,
    blocks: BlocksOption = None,
    iterations: Annotated[
        int | None,
        typer.Option(metavar="N", help="Of Stage I and of each block. Default: 30,000."),
    ] = None,
    width: WidthOption = None,
    device: DeviceOption = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="GIB",
            help="Memory that a task may take; Gaussians grow to what fits.",
            rich_help_panel=_SETTINGS,
        ),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            metavar="paper|authors|panolog",
            help="Preset of what is not given. Default: panolog.",
            rich_help_panel=_SETTINGS,
        ),
    ] = None,
) -> "RunConfig":
    """The options that set up a run, as its settings."""
    from panolog.orchestrator.runs.config import load_config

    flags = {"blocks": blocks, "iterations": iterations, "width": width, "device": device}
    return load_config(config, settings or (), flags | {"memory": memory, "recipe": recipe})


def preparation(
    parallax: ParallaxOption = None,
    frames: FramesOption = None,
    up: UpOption = None,
    distance: DistanceOption = None,
    trajectory: TrajectoryOption = None,
    gps: GpsOption = True,
    partial: PartialOption = False,
    nadir: Annotated[
        float | None,
        typer.Option(
            metavar="DEGREES",
            min=0,
            max=90,
            help="Mask so much around straight down. Default: 10, unless there are masks.",
            rich_help_panel=_MADE,
        ),
    ] = None,
    static: Annotated[
        bool | None,
        typer.Option(
            "--static/--no-static",
            help="Mask what all panoramas show. Default: yes, unless there are masks.",
            show_default=False,
            rich_help_panel=_MADE,
        ),
    ] = None,
    depth_model: Annotated[
        Path | None,
        typer.Option(
            metavar="M.onnx",
            help="Estimate depth with this network.",
            rich_help_panel=_MADE,
        ),
    ] = None,
) -> "Options":
    """The options that make a scene of panoramas or a video, as far as they are not the defaults."""
    from panolog.orchestrator.runs.preparation.settings import Options

    values = {"parallax": parallax, "frames": frames, "up": up, "distance": distance}
    sfm: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    sfm |= {"trajectory": str(trajectory)} if trajectory is not None else {}
    sfm |= {"gps": False} if not gps else {}
    sfm |= {"partial": True} if partial else {}
    model = None if depth_model is None else str(depth_model)
    return Options(sfm=sfm, nadir=nadir, static=static, depth_model=model)


def with_run_config(command: Callable[..., None]) -> Callable[..., None]:
    """Replaces the parameter `config` of a command by the options of `run_config`, which make its value."""
    return _replacing(command, "config", run_config)


def with_preparation(command: Callable[..., None]) -> Callable[..., None]:
    """Replaces the parameter `options` of a command by those of `preparation`, which make its value."""
    return _replacing(command, "options", preparation)


def _replacing(command: Callable[..., None], replaced: str, make: Callable[..., Any]) -> Callable[..., None]:
    """Replaces a parameter of a command by those of `make`, which make its value."""
    own, shared = inspect.signature(command).parameters, inspect.signature(make).parameters

    @wraps(command)
    def wrapper(**options: Any) -> None:
        value = make(**{name: options.pop(name) for name in shared})
        command(**{replaced: value}, **options)

    parameters = [
        new
        for name, parameter in own.items()
        for new in (shared.values() if name == replaced else (parameter,))
    ]
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # read by typer
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return wrapper
