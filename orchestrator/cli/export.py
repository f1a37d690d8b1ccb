"""`panolog export`."""

from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.console import print_result, progress_bar
from panolog.orchestrator.cli.options import JsonOption, ModelArg
from panolog.scene.errors import InputError

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_FORMAT = "Formats"
_CHOICE = "What of the model"
_PLACE = "Where it is"


def export(
    source: ModelArg,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE|FOLDER",
            help="One file, whose ending says the format; or a folder.",
        ),
    ],
    sog: Annotated[bool, typer.Option("--sog", help="SOG of PlayCanvas.", rich_help_panel=_FORMAT)] = False,
    web: Annotated[
        bool,
        typer.Option(
            "--web", help="Streamed SOG with a viewer, for any web server.", rich_help_panel=_FORMAT
        ),
    ] = False,
    spz: Annotated[bool, typer.Option("--spz", help="SPZ of Niantic.", rich_help_panel=_FORMAT)] = False,
    compressed_ply: Annotated[
        bool, typer.Option("--compressed-ply", help="PLY of SuperSplat.", rich_help_panel=_FORMAT)
    ] = False,
    glb: Annotated[
        bool, typer.Option("--glb", help="glTF with KHR_gaussian_splatting.", rich_help_panel=_FORMAT)
    ] = False,
    tiles: Annotated[
        bool, typer.Option("--3dtiles", help="3D Tiles for globes such as Cesium.", rich_help_panel=_FORMAT)
    ] = False,
    sky_image: Annotated[
        bool,
        typer.Option(
            "--sky-image", help="The sky as a panorama: sky.jpg and sky.exr.", rich_help_panel=_FORMAT
        ),
    ] = False,
    without_sky: Annotated[
        bool, typer.Option("--without-sky", help="The scene alone.", rich_help_panel=_CHOICE)
    ] = False,
    sh: Annotated[
        int,
        typer.Option(
            metavar="0..3", min=0, max=3, help="Degree of spherical harmonics.", rich_help_panel=_CHOICE
        ),
    ] = 3,
    min_opacity: Annotated[
        float,
        typer.Option(
            metavar="0..1", min=0, max=0.999, help="Leave out what is fainter.", rich_help_panel=_CHOICE
        ),
    ] = 0.0,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,X,Y,Z",
            help="Lower and upper corner of what is kept, in the model's coordinates.",
            rich_help_panel=_CHOICE,
        ),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=8,
            help="Levels of detail of --web and --3dtiles. Default: as many as it takes.",
            rich_help_panel=_CHOICE,
        ),
    ] = None,
    spz_version: Annotated[
        int,
        typer.Option(
            metavar="3|4", min=3, max=4, help="Version of SPZ; 4 is smaller.", rich_help_panel=_CHOICE
        ),
    ] = 3,
    up: Annotated[
        str | None,
        typer.Option(
            metavar="z|-y|X,Y,Z",
            help="The model's direction up. Default: that of a run's cameras, -y of a PLY.",
            rich_help_panel=_PLACE,
        ),
    ] = None,
    epsg: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, help="Coordinate system of the scene's coordinates.", rich_help_panel=_PLACE
        ),
    ] = None,
    metres: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            min=1e-6,
            help="Metres of a unit. Default: as the scene says.",
            rich_help_panel=_PLACE,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a model as small files for viewers, browsers, engines and globes."""
    if not source.exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
    wanted = {
        "sog": sog,
        "web": web,
        "spz": spz,
        "compressed-ply": compressed_ply,
        "glb": glb,
        "3dtiles": tiles,
        "sky-image": sky_image,
    }
    box = None if crop is None else _box(crop)
    direction = None if up is None else _direction(up)
    with progress_bar("reading the model") as show:
        from panolog.export.splats import Selection
        from panolog.orchestrator.commands.export import ExportSpec, export_model
        from panolog.orchestrator.commands.models import size_of

        spec = ExportSpec(
            formats=tuple(name for name, given in wanted.items() if given),
            selection=Selection(degree=sh, min_opacity=min_opacity, crop=box),
            sky=not without_sky,
            levels=levels,
            spz=4 if spz_version == 4 else 3,
            up=direction,
            epsg=epsg,
            metres=metres,
        )
        written = export_model(source, output, spec, show)
    sizes = {str(path): size_of(path) for path in written}
    lines = (f"{path}  {size / 1e6:,.1f} MB" for path, size in sizes.items())
    print_result(
        {"files": [{"path": path, "bytes": size} for path, size in sizes.items()]}, lines, as_json=as_json
    )


def _numbers(option: str, text: str, count: int) -> tuple[float, ...]:
    try:
        found = tuple(map(float, text.split(",")))
    except ValueError as error:
        raise InputError(f"{option} {text}: write {count} numbers, with commas between them") from error
    if len(found) != count:
        raise InputError(f"{option} {text}: write {count} numbers, with commas between them")
    return found


def _box(text: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    a, b, c, x, y, z = _numbers("--crop", text, 6)
    if not (a < x and b < y and c < z):
        raise InputError(f"--crop {text}: the first three numbers must be less than the others")
    return (a, b, c), (x, y, z)


def _direction(text: str) -> tuple[float, float, float]:
    axis = text.lstrip("+-").lower()
    if axis in _AXES:
        sign = -1.0 if text.startswith("-") else 1.0
        x, y, z = (sign * value + 0.0 for value in _AXES[axis])
    else:
        x, y, z = _numbers("--up", text, 3)
    return x, y, z
