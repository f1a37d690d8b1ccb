"""`panolog scene`: info, check, import, sfm, mask, depth. From the files of a camera to a scene to run."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from panolog.orchestrator.cli.console import print_result, progress_bar, say
from panolog.orchestrator.cli.options import JsonOption, LinkOption, NewSceneOption, SceneArg
from panolog.scene.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Inspect a scene or make one.")

_NETWORK_HELP = "ONNX network, with its manifest M.yaml next to it."
NetworkDeviceOption = Annotated[
    str, typer.Option("--device", metavar="auto|cpu|cuda|tensorrt", help="Device of the network.")
]
BatchOption = Annotated[int, typer.Option(min=1, max=1024, help="Pictures per call of the network.")]


@app.command()
def info(scene: SceneArg, as_json: JsonOption = False) -> None:
    """Show what a scene contains, and whether it is sound."""
    from panolog.orchestrator.commands.scene import describe, lines
    from panolog.scene.read import read_scene

    description = describe(read_scene(scene))
    print_result(description, lines(description), as_json=as_json)


@app.command()
def check(scene: SceneArg, as_json: JsonOption = False) -> None:
    """Check that poses, points and panoramas fit: axes, handedness, names, pixel convention."""
    from panolog.prepare.check.scene_check import check_scene
    from panolog.scene.read import read_scene

    found = check_scene(read_scene(scene))
    problems = [f"WRONG   {problem}" for problem in found.problems]
    print_result(asdict(found), [*found.lines(), *problems], as_json=as_json)
    if problems:
        raise typer.Exit(2)


@app.command("import")
def import_(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of another program.")],
    output: NewSceneOption,
    format: Annotated[
        str | None, typer.Option(metavar="NAME", help="Its format (docs/import.md). Default: detected.")
    ] = None,
    images: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder of the panoramas.")] = None,
    points: Annotated[Path | None, typer.Option(metavar="PLY", help="Point cloud to use instead.")] = None,
    link: LinkOption = False,
    as_json: JsonOption = False,
) -> None:
    """Convert a scene of openMVG, OpenSfM, nerfstudio, Metashape, SphereSfM and others."""
    from panolog.prepare.importers.import_scene import import_scene
    from panolog.prepare.importers.interface import ImportSource

    with progress_bar(resumable=False) as show:
        report = import_scene(
            ImportSource(source, images, points),
            output,
            format=format,
            link=link,
            progress=lambda done, total: show("import", done, total),
        )
    for note in () if as_json else report.notes:
        say(note)
    line = (
        f"{output}: {report.panoramas} panoramas, {report.points:,} points, "
        f"{report.observations:,} observations, from {report.format}"
    )
    print_result({"scene": str(output), **asdict(report)}, [line], as_json=as_json)
    _suggest_check(output, as_json=as_json)


@app.command()
def sfm(
    source: Annotated[
        Path, typer.Argument(metavar="IMAGES|VIDEO", help="Folder of panoramas, or a 360° video.")
    ],
    output: NewSceneOption,
    pairs: Annotated[
        Literal["auto", "exhaustive", "sequential"], typer.Option(help="Which panoramas are matched.")
    ] = "auto",
    mapper: Annotated[
        Literal["incremental", "global"], typer.Option(help="How the poses are found.")
    ] = "incremental",
    parallax: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Video: parallax between two frames.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=2, help="Video: maximum number of frames.")] = None,
    distance: Annotated[
        tuple[str, str, float] | None,
        typer.Option(metavar="NAME NAME METRES", help="Distance of two panoramas, which sets the scale."),
    ] = None,
    gps: Annotated[bool, typer.Option(help="Take metres and north from the GPS in EXIF.")] = True,
    partial: Annotated[
        bool, typer.Option("--partial", help="Accept poses for half of the panoramas or fewer.")
    ] = False,
    link: LinkOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find poses and points for raw panoramas or a 360° video: a scene for `panolog run`."""
    from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
    from panolog.prepare.sfm.report import write_report
    from panolog.prepare.video.frames import PARALLAX

    settings = SfmSettings(
        pairing=pairs,
        mapper=mapper,
        partial=partial,
        gps=gps,
        distance=distance,
        parallax=PARALLAX if parallax is None else parallax,
        frames=frames,
        link=link,
    )
    with progress_bar() as show:
        report = make_scene(source, output, settings, show)
    write_report(output, report)
    print_result({"scene": str(output), **report.as_json()}, report.lines(), as_json=as_json)
    _suggest_check(output, as_json=as_json, drawn=output / "sfm.png")


@app.command()
def mask(
    scene: SceneArg,
    nadir: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Ignore this angle around straight down.")
    ] = None,
    static: Annotated[
        bool, typer.Option("--static", help="Ignore what stays the same around the nadir: the operator.")
    ] = False,
    model: Annotated[
        Path | None, typer.Option(metavar="M.onnx", help=f"Ignore what it finds. {_NETWORK_HELP}")
    ] = None,
    batch: BatchOption = 2,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Mask the operator, the tripod and movers; combined with existing masks."""
    if nadir is None and not static and model is None:
        raise InputError(
            "nothing to mask: give --nadir DEGREES, --static, --model M.onnx, or several of them"
        )
    if nadir is not None and not 0 < nadir <= 90:
        raise InputError(f"--nadir {nadir:g}: give an angle from straight down, above 0 and up to 90 degrees")
    from panolog.orchestrator.commands.scene import mask_scene
    from panolog.prepare.networks.masks import mask_lines

    with progress_bar() as show:
        described = mask_scene(
            scene, nadir=nadir, static=static, model=model, batch=batch, device=device, progress=show
        )
    print_result(described, mask_lines(described), as_json=as_json)


@app.command()
def depth(
    scene: SceneArg,
    model: Annotated[Path, typer.Option("--model", metavar="M.onnx", help=_NETWORK_HELP)],
    batch: BatchOption = 2,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Estimate depth maps and sky masks with an ONNX network, and align them to the sparse points."""
    from panolog.orchestrator.commands.scene import estimate_depth

    with progress_bar() as show:
        described = estimate_depth(scene, model, batch=batch, device=device, say=say, progress=show)
    print_result(described.as_json(), described.lines(), as_json=as_json)


def _suggest_check(scene: Path, *, as_json: bool, drawn: Path | None = None) -> None:
    if not as_json:
        shown = f"{drawn} shows the poses; " if drawn else ""
        say(f"{shown}`panolog scene check {scene}` checks that poses, points and panoramas fit")
