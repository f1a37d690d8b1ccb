"""Options and arguments that several commands share, each declared once."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from panolog.orchestrator.cli.syntax import argument, flag, option
from panolog.scene.errors import ConfigError, InputError

if TYPE_CHECKING:
    from panolog.orchestrator.runs.config import RunConfig
    from panolog.orchestrator.runs.money.limits import Wanted
    from panolog.orchestrator.runs.preparation.settings import Options

T = TypeVar("T")
# Panels of the help, besides that of the basic options.
_SETTINGS, _MACHINES, _TOLD = "Settings", "Machines and the driver", "Notifications and logs"
BUDGET = "Cost and time (docs/money.md)"
_MADE = "Panoramas or a video instead of a scene"
_setting, _machine, _note, _limit, _making = (
    partial(option, panel=panel) for panel in (_SETTINGS, _MACHINES, _TOLD, BUDGET, _MADE)
)
_RESUMES = 10  # of a supervisor in a row without progress
HTML = (".html", ".htm")  # endings of a page that is one file


def _html(path: Path | None) -> Path | None:
    """Raises InputError if a page would replace another kind of file, or be taken for one."""
    if path is not None and path.suffix.lower() not in ("", *HTML):
        raise InputError(f"{path}: the page is HTML; give -o FILE.html")
    return path


SourcesArg = Annotated[
    list[str],
    argument(
        "SCENE|SOURCE...",
        "Scene (folder, s3://, gs://, az://); or folders of panoramas and 360° videos, one or several.",
    ),
]
SceneArg = Annotated[Path, argument("SCENE", "Folder of a COLMAP or Pano360 scene.")]
AnySceneArg = Annotated[str, argument("SCENE", "Folder or URL of a COLMAP or Pano360 scene.")]
AnyRunArg = Annotated[str, argument("RUN", "Folder or URL of a run.")]
RunArg = Annotated[Path, argument("RUN", "Folder of a run.")]
ModelArg = Annotated[Path, argument("RUN|PLY", "Folder of a run, or a PLY file.")]
BlockArg = Annotated[int, argument("BLOCK", "Number of a block.", min=0)]
LocalOption = Annotated[
    Path | None,
    _machine("DIR", "Folder on this machine of a run with a URL. Default: in the cache.", "--local"),
]
NewSceneOption = Annotated[Path, option("SCENE", "Folder of the new scene.", "--output", "-o")]
PageOption = Annotated[
    Path | None, option("FILE.html", "Write the page to this file.", "--output", "-o", callback=_html)
]
JsonOption = Annotated[bool, flag("Print one JSON object on stdout.", "--json")]
LinkOption = Annotated[bool, flag("Link the panoramas instead of copying them.", "--link")]
AddressOption = Annotated[
    str | None, _machine("HOST:PORT|auto", "Ray cluster to run on. Default: this machine.")
]
NotifyOption = Annotated[
    list[str] | None,
    _note("KIND:URL", "Notify by webhook, slack, ntfy or mail (docs/notifications.md); repeatable."),
]
PricesOption = Annotated[
    str | None, _limit("FILE", "Prices of machines. Default: ~/.config/panolog/prices.toml.")
]
AcceptOption = Annotated[
    bool,
    flag("Continue with the settings of a run.json that was edited since.", "--accept-changes"),
]
AtEndOption = Annotated[
    str | None,
    _limit("COMMAND", "Carried out when the run has ended for good, but not if it is stopped.", "--at-end"),
]
DeviceOption = Annotated[str | None, option("auto|cpu|cuda", "Device to compute on. Default: auto.")]
BlocksOption = Annotated[
    str | None, option("2x1x1|8|auto", "Blocks along x, y, z; so many balanced ones; or as many as it takes.")
]
FrameOption = Annotated[
    Literal["export", "model"],
    option(
        "export|model",
        "Axes of FILE if it is no plain PLY: as `panolog export` writes it, or as the run's model.",
    ),
]

ParallaxOption = Annotated[
    float | None, _making("DEGREES", "Video: parallax between two frames. Default: 4.")
]
UpOption = Annotated[
    Literal["up", "right", "down", "left"] | None,
    _making("up|right|down|left", "Two lenses, not stitched: where up is in the first circle. Default: up."),
]
FramesOption = Annotated[int | None, _making("N", "Video: take at most N frames of each.", min=2)]


@dataclass(frozen=True)
class DriverOptions:
    """How this machine drives a run."""

    address: str | None  # of a Ray cluster
    nice: int | None
    dashboard: bool
    resumes: int | None  # of a supervisor, in a row without progress; None = there is no supervisor

    def words(self) -> list[str]:
        """Options with these values, without those of a supervisor."""
        values = {"--address": self.address, "--nice": self.nice}
        given = [str(word) for name, value in values.items() if value is not None for word in (name, value)]
        return given + ["--dashboard"] * self.dashboard


def driving(
    address: AddressOption = None,
    nice: Annotated[
        int | None, _machine("N", "Let other programs go first: 0 to 19. Default: 0.", min=0, max=19)
    ] = None,
    dashboard: Annotated[
        bool, flag("Show the run in the browser while it runs.", "--dashboard", panel=_MACHINES)
    ] = False,
    supervise: Annotated[
        bool,
        flag(
            "Resume the run when its driver is killed or crashes, or its cluster is lost.",
            "--supervise",
            panel=_MACHINES,
        ),
    ] = False,
    max_resumes: Annotated[
        int | None, _machine("N", "With --supervise: resumes in a row without progress. Default: 10.", min=1)
    ] = None,
) -> DriverOptions:
    """The values of these options. Raises ConfigError for a limit of resumes without a supervisor."""
    if max_resumes is not None and not supervise:
        raise ConfigError(f"--max-resumes {max_resumes}: only with --supervise, which resumes; add it")
    return DriverOptions(address, nice, dashboard, (max_resumes or _RESUMES) if supervise else None)


def followed(
    notify: NotifyOption = None,
    log: Annotated[
        list[str] | None, _note("SINK", "Curves also to mlflow, tensorboard or wandb; repeatable.")
    ] = None,
) -> tuple[list[str], list[str]]:
    """The values of these options."""
    return notify or [], log or []


def wanted(
    prices: PricesOption = None,
    max_cost: Annotated[
        str | None,
        _limit("AMOUNT|none", "End the training before the run costs more, and deliver what there is."),
    ] = None,
    deadline: Annotated[str | None, _limit("6h|08:00|none", "The same, so that all is done by then.")] = None,
) -> "Wanted":
    """The values of these options. Raises ConfigError if one is wrong."""
    from panolog.orchestrator.runs.money.limits import Wanted
    from panolog.orchestrator.runs.money.prices import find_prices

    return Wanted.of(max_cost, deadline, find_prices(prices))


def run_config(
    config: Annotated[Path | None, _setting("F.yaml", "Settings in YAML.")] = None,
    settings: Annotated[list[str] | None, _setting("KEY=VALUE", "One setting; repeatable.", "--set")] = None,
    blocks: BlocksOption = None,
    iterations: Annotated[int | None, option("N", "Of Stage I and of each block. Default: 30,000.")] = None,
    width: Annotated[int | None, option("W", "Of the panoramas in pixels. Default: as they are.")] = None,
    holdout: Annotated[
        str | None,
        _setting("scene|none", "Panoramas to measure on. Default: the scene's split, or every 8th."),
    ] = None,
    device: DeviceOption = None,
    memory: Annotated[
        str | None, _setting("GIB", "Memory that a task may take; Gaussians grow to what fits.")
    ] = None,
    recipe: Annotated[
        str | None, _setting("paper|authors|panolog", "Preset of what is not given. Default: panolog.")
    ] = None,
) -> "RunConfig":
    """The options that set up a run, as its settings."""
    from panolog.orchestrator.runs.config import load_config

    flags: dict[str, Any] = {"blocks": blocks, "iterations": iterations, "width": width, "device": device}
    flags |= {"holdout": holdout, "memory": memory, "recipe": recipe}
    return load_config(config, settings or (), flags)


def reconstruction(
    parallax: ParallaxOption = None,
    frames: FramesOption = None,
    up: UpOption = None,
    distance: Annotated[
        tuple[str, str, float] | None,
        _making("NAME NAME METRES", "Distance between two of them; sets the scale."),
    ] = None,
    trajectory: Annotated[Path | None, _making("FILE", "Known trajectory, TUM or CSV (docs/sfm.md).")] = None,
    gps: Annotated[
        bool, flag("Scale and north from GPS in EXIF.", "--gps/--no-gps", panel=_MADE, show_default=False)
    ] = True,
    partial: Annotated[
        bool, flag("Accept poses of half of the panoramas or fewer.", "--partial", panel=_MADE)
    ] = False,
) -> dict[str, Any]:
    """The options that find poses: fields of `SfmSettings`, as far as they are not the defaults."""
    values: dict[str, Any] = {"parallax": parallax, "frames": frames, "up": up, "distance": distance}
    values |= {"trajectory": trajectory, "gps": None if gps else False, "partial": partial or None}
    return {name: value for name, value in values.items() if value is not None}


def grouped(**groups: Callable[..., Any]) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Replaces parameters of a function by the options of the functions that make their values."""
    shared = {name: inspect.signature(make).parameters for name, make in groups.items()}

    def replaced(command: Callable[..., T]) -> Callable[..., T]:
        @wraps(command)
        def wrapper(**options: Any) -> T:
            made = {name: groups[name](**{one: options.pop(one) for one in shared[name]}) for name in groups}
            return command(**made, **options)

        parameters = [
            new.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for name, parameter in inspect.signature(command).parameters.items()
            for new in (shared[name].values() if name in shared else (parameter,))
        ]
        wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # read by typer
        wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return wrapper

    return replaced


@grouped(sfm=reconstruction)
def preparation(
    sfm: dict[str, Any],
    nadir: Annotated[
        float | None,
        _making(
            "DEGREES",
            "Mask so much around straight down. Default: 10, unless there are masks.",
            min=0,
            max=90,
        ),
    ] = None,
    static: Annotated[
        bool | None,
        flag(
            "Mask what all panoramas show. Default: yes, unless there are masks.",
            "--static/--no-static",
            panel=_MADE,
            show_default=False,
        ),
    ] = None,
    mask_model: Annotated[Path | None, _making("M.onnx", "Mask what this network finds, as people.")] = None,
    depth_model: Annotated[Path | None, _making("M.onnx", "Estimate depth with this network.")] = None,
) -> "Options":
    """The options that make a scene of panoramas or a video, as far as they are not the defaults."""
    from panolog.orchestrator.runs.preparation.settings import Options

    sfm |= {"trajectory": str(sfm["trajectory"])} if "trajectory" in sfm else {}
    mask, depth = (None if model is None else str(model) for model in (mask_model, depth_model))
    return Options(sfm=sfm, nadir=nadir, static=static, mask_model=mask, depth_model=depth)
