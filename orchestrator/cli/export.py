"""`panolog export`."""

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

from panolog.orchestrator.cli.console import print_result, progress_bar, say
from panolog.orchestrator.cli.options import JsonOption
from panolog.orchestrator.cli.stores import opened
from panolog.orchestrator.cli.syntax import argument, flag, option
from panolog.scene.errors import InputError
from panolog.scene.stores.url import is_url

_CHOICE = "What of the model"
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_format = partial(flag, panel="Formats")
_choice = partial(option, panel=_CHOICE)
_place = partial(option, panel="Where it is")

Crop = Annotated[
    str | None,
    _choice("X,Y,Z,X,Y,Z", "Lower and upper corner of what is kept, in the model's coordinates."),
]
MaxSize = Annotated[
    float | None,
    _choice("U", "Leave out what is larger: its longest standard deviation, in the model's units.", min=1e-9),
]
MaxDistance = Annotated[
    float | None,
    _choice("U", "Leave out what is farther from all of a run's cameras, in the model's units.", min=1e-9),
]
Levels = Annotated[
    int | None,
    _choice("N", "Levels of detail of --web and --3dtiles. Default: as many as it takes.", min=1, max=8),
]
Up = Annotated[
    str | None,
    _place("z|-y|X,Y,Z", "The model's direction up. Default: that of a run's cameras, -y of a PLY."),
]
Geoid = Annotated[
    float | None,
    _place("M", "Heights are above the sea: how high that is there above the ellipsoid.", min=-120, max=120),
]
Output = Annotated[
    Path, option("FILE|FOLDER", "One file, whose ending says the format; or a folder.", "--output", "-o")
]


def export(
    source: Annotated[str, argument("RUN|PLY", "Folder or URL of a run, or a PLY file.")],
    output: Output,
    sog: Annotated[bool, _format("SOG of PlayCanvas.", "--sog")] = False,
    web: Annotated[
        bool, _format("Streamed SOG with a page that shows it, for any web server.", "--web")
    ] = False,
    spz: Annotated[bool, _format("SPZ of Niantic.", "--spz")] = False,
    compressed_ply: Annotated[bool, _format("PLY of SuperSplat.", "--compressed-ply")] = False,
    ply: Annotated[bool, _format("PLY of all trainers, turned upright for viewers.", "--ply")] = False,
    glb: Annotated[bool, _format("glTF with KHR_gaussian_splatting.", "--glb")] = False,
    tiles: Annotated[bool, _format("3D Tiles for globes such as Cesium.", "--3dtiles")] = False,
    sky_image: Annotated[bool, _format("The sky as a panorama: sky.jpg and sky.exr.", "--sky-image")] = False,
    without_sky: Annotated[bool, flag("The scene alone.", "--without-sky", panel=_CHOICE)] = False,
    sh: Annotated[int, _choice("0..3", "Degree of spherical harmonics.", min=0, max=3)] = 3,
    min_opacity: Annotated[float, _choice("0..1", "Leave out what is fainter.", min=0, max=0.999)] = 0.0,
    max_size: MaxSize = None,
    max_distance: MaxDistance = None,
    crop: Crop = None,
    levels: Levels = None,
    spz_version: Annotated[int, _choice("3|4", "Version of SPZ.", min=3, max=4)] = 3,
    up: Up = None,
    epsg: Annotated[int | None, _place("N", "Coordinate system of the scene's coordinates.", min=1)] = None,
    metres: Annotated[
        float | None, _place("M", "Metres of a unit. Default: as the scene says.", min=1e-6)
    ] = None,
    geoid: Geoid = None,
    as_json: JsonOption = False,
) -> None:
    """Write a model as small files for viewers, browsers, engines and globes."""
    if not is_url(source) and not Path(source).exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
    wanted = {"sog": sog, "web": web, "spz": spz, "compressed-ply": compressed_ply, "ply": ply}
    wanted |= {"glb": glb, "3dtiles": tiles, "sky-image": sky_image}
    box, direction = crop and _box(crop), up and direction_of(up)
    with opened(source, "export") as (root, _), progress_bar("reading the model") as show:
        from panolog.export.splats import Selection
        from panolog.orchestrator.cli.commands.export import ExportSpec, export_model
        from panolog.orchestrator.cli.commands.models import size_of

        spec = ExportSpec(
            formats=tuple(name for name, given in wanted.items() if given),
            selection=Selection(degree=sh, min_opacity=min_opacity, max_size=max_size, crop=box or None),
            max_distance=max_distance,
            sky=not without_sky,
            levels=levels,
            spz=4 if spz_version == 4 else 3,
            up=direction or None,
            epsg=epsg,
            metres=metres,
            geoid=geoid,
        )
        sizes = {str(path): size_of(path) for path in export_model(root, output, spec, show, say)}
    lines = (f"{path}  {size / 1e6:,.1f} MB" for path, size in sizes.items())
    files = [{"path": path, "bytes": size} for path, size in sizes.items()]
    print_result({"files": files}, lines, as_json=as_json)


def _numbers(option: str, text: str, count: int) -> tuple[float, ...]:
    with suppress(ValueError):
        if len(found := tuple(map(float, text.split(",")))) == count:
            return found
    raise InputError(f"{option} {text}: write {count} numbers, with commas between them")


def _box(text: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    a, b, c, x, y, z = _numbers("--crop", text, 6)
    if not (a < x and b < y and c < z):
        raise InputError(f"--crop {text}: the first three numbers must be less than the others")
    return (a, b, c), (x, y, z)


def direction_of(text: str) -> tuple[float, float, float]:
    """The value of `--up`: an axis with its sign, or three numbers. Raises InputError for anything else."""
    axis = text.lstrip("+-").lower()
    if axis in _AXES:
        sign = -1.0 if text.startswith("-") else 1.0
        x, y, z = (sign * value + 0.0 for value in _AXES[axis])
    else:
        x, y, z = _numbers("--up", text, 3)
    return x, y, z
