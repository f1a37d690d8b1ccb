"""`panolog scene`: info, check, import, stitch, sfm, mask, depth. From the files of a camera to a scene."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from panolog.orchestrator.cli.console import command, print_result, progress_bar, say
from panolog.orchestrator.cli.options import (
    AnySceneArg,
    FramesOption,
    JsonOption,
    LinkOption,
    NewSceneOption,
    ParallaxOption,
    SceneArg,
    UpOption,
    grouped,
    reconstruction,
)
from panolog.orchestrator.cli.syntax import Command, Group, argument, flag, option
from panolog.scene.errors import InputError

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    help="Make scenes and check them: stitch, sfm, import, info, check, mask, depth.",
)

_NETWORK_HELP = "ONNX, with its manifest M.yaml next to it."
NetworkDeviceOption = Annotated[str, option("auto|cpu|cuda|tensorrt", "Device of the network.", "--device")]
BatchOption = Annotated[int, option("N", "Panoramas per call of the network.", min=1, max=1024)]


@app.command(cls=Command)
def info(scene: AnySceneArg, as_json: JsonOption = False) -> None:
    """Show what a scene contains."""
    with progress_bar("reading the scene"):
        from panolog.orchestrator.cli.commands.scene import describe, lines
        from panolog.scene.read import read_scene

        description = describe(read_scene(scene))
    print_result(description, lines(description), as_json=as_json)


@app.command(cls=Command)
def check(scene: AnySceneArg, as_json: JsonOption = False) -> None:
    """Check that poses, points and panoramas fit together."""
    with progress_bar("checking the scene"):
        from panolog.prepare.check.scene_check import check_scene
        from panolog.scene.read import read_scene

        found = check_scene(read_scene(scene))
    problems = [f"WRONG   {problem}" for problem in found.problems]
    print_result(asdict(found), [*found.lines(), *problems, found.verdict], as_json=as_json)
    if problems:
        raise typer.Exit(2)


@app.command("import", cls=Command)
def import_(
    source: Annotated[Path, argument("SOURCE", "Scene of another program: a file or a folder.")],
    output: NewSceneOption,
    format: Annotated[
        str | None, option("NAME", "Format of SOURCE (docs/import.md). Default: detected.")
    ] = None,
    images: Annotated[
        Path | None, option("FOLDER", "Folder of the panoramas, if SOURCE does not name it.")
    ] = None,
    points: Annotated[Path | None, option("PLY", "Point cloud to use instead of the one in SOURCE.")] = None,
    link: LinkOption = False,
    as_json: JsonOption = False,
) -> None:
    """Convert a scene of openMVG, OpenSfM, nerfstudio, Metashape, SphereSfM and others."""
    from panolog.orchestrator.runs.machines.machine import memory
    from panolog.prepare.importers.import_scene import import_scene
    from panolog.prepare.importers.interface import ImportSource

    with progress_bar("reading the source") as show:
        report = import_scene(
            ImportSource(source, images, points, memory=memory() // 2),  # the other half: writing the scene
            output,
            format=format,
            link=link,
            progress=show,
        )
    for note in () if as_json else report.notes:
        say(note)
    line = (
        f"{output}: {report.panoramas} panoramas, {report.points:,} points, "
        f"{report.observations:,} observations, from {report.format}"
    )
    print_result({"scene": str(output), **asdict(report)}, [line], as_json=as_json)
    _suggest_check(output, as_json=as_json)


@app.command(cls=Command)
def stitch(
    source: Annotated[
        Path, argument("IMAGES|VIDEO", "Folder of pictures of two fisheye circles, or a video of them.")
    ],
    output: Annotated[Path, option("FOLDER", "Folder of the panoramas.", "--output", "-o")],
    width: Annotated[
        int | None, option("PIXELS", "Of the panoramas. Default: as of the lenses.", min=64, max=16384)
    ] = None,
    up: UpOption = None,
    parallax: ParallaxOption = None,
    frames: FramesOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make panoramas of pictures or a video that show two fisheye circles."""
    from panolog.prepare.raw_files import stitch_source
    from panolog.prepare.video.frames import FrameChoice
    from panolog.prepare.video.selection import PARALLAX

    choice = FrameChoice(PARALLAX if parallax is None else parallax, frames, up)
    with progress_bar("looking for the lenses", resumable=True) as show:
        report = stitch_source(source, output, width=width, choice=choice, progress=show)
    print_result(report.as_json(), report.lines(), as_json=as_json)


@app.command(cls=Command)
@grouped(options=reconstruction)
def sfm(
    source: Annotated[
        list[Path], argument("SOURCE...", "Folders of panoramas and 360° videos, one or several.")
    ],
    output: NewSceneOption,
    *,
    into: Annotated[
        Path | None,
        option("SCENE", "Add them to this scene, of which nothing moves; -o gets both.", "--into"),
    ] = None,
    pairs: Annotated[
        Literal["auto", "exhaustive", "sequential"],
        option("HOW", "Pairs to match: auto, exhaustive or sequential.", "--pairs"),
    ] = "auto",
    mapper: Annotated[
        Literal["incremental", "global"], option("HOW", "Mapper: incremental or global.")
    ] = "incremental",
    options: dict[str, Any],
    link: LinkOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make a scene from raw panoramas and 360° videos, also several: find poses and points."""
    from panolog.orchestrator.runs.machines.machine import memory_of_preparation
    from panolog.prepare.sfm.joining.join import join_scene
    from panolog.prepare.sfm.pipeline import SfmSettings, make_scene

    parts = options.get("partial", False)
    settings = SfmSettings(**options, pairing=pairs, mapper=mapper, parts=parts, link=link)
    with progress_bar("reading the panoramas", resumable=True) as show:
        free = memory_of_preparation()
        if into is not None:
            report = join_scene(source, into, output, settings, show, memory=free)
        else:
            given = source if len(source) > 1 else source[0]
            report = make_scene(given, output, settings, show, memory=free)
    print_result({"scene": str(output), **report.as_json()}, report.lines(), as_json=as_json)
    _suggest_check(output, as_json=as_json, drawn=output / "sfm.png")


@app.command(cls=Command)
def mask(
    scene: SceneArg,
    nadir: Annotated[
        str | None,
        option(
            "DEGREES|auto",
            "Mask everything within this angle of straight down; auto: the cap that is black there.",
        ),
    ] = None,
    static: Annotated[
        bool,
        flag("Mask what looks the same in all panoramas around straight down: the operator.", "--static"),
    ] = False,
    model: Annotated[Path | None, option("M.onnx", f"Mask what this network finds. {_NETWORK_HELP}")] = None,
    batch: BatchOption = 2,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Mask the operator, the tripod and moving objects; existing masks are kept."""
    if nadir is None and not static and model is None:
        raise InputError(
            "nothing to mask: give --nadir DEGREES, --static, --model M.onnx, or several of them"
        )
    angle = None if nadir is None else _nadir_angle(nadir)
    from panolog.prepare.networks.masks import mask_lines, mask_scene

    with progress_bar("reading the panoramas", resumable=True) as show:
        described = mask_scene(
            scene, nadir=angle, static=static, model=model, batch=batch, device=device, progress=show
        )
    print_result(described, mask_lines(described), as_json=as_json)


@app.command(cls=Command)
def depth(
    scene: SceneArg,
    model: Annotated[Path, option("M.onnx", f"Network. {_NETWORK_HELP}", "--model")],
    batch: BatchOption = 2,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Estimate depth maps and sky masks with an ONNX network."""
    from panolog.prepare.networks.depth_report import estimate_depth

    with progress_bar("reading the panoramas", resumable=True) as show:
        described = estimate_depth(scene, model, batch=batch, device=device, say=say, progress=show)
    print_result(described.as_json(), described.lines(), as_json=as_json)


def models(
    model: Annotated[Path | None, argument("M.onnx", "Network to check. Default: list those known.")] = None,
    width: Annotated[
        int, option("W", "Of the panoramas of the trial in pixels.", "--width", min=64, max=16384)
    ] = 2048,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """List networks for --mask-model and --depth-model, or check one; nothing is downloaded."""
    from panolog.prepare.networks.catalogue import check_network, list_lines, networks_as_json

    if model is None:
        print_result(networks_as_json(), list_lines(), as_json=as_json)
        return
    with progress_bar("trying the network"):
        checked = check_network(model, width, device, say)
    print_result(asdict(checked), checked.lines(), as_json=as_json)


def _nadir_angle(text: str) -> float | Literal["auto"]:
    """The value of --nadir. Raises InputError if it is none."""
    if text == "auto":
        return "auto"
    try:
        degrees = float(text)
    except ValueError:
        degrees = 0.0
    if not 0 < degrees <= 90:
        raise InputError(f"--nadir {text[:40]}: give an angle up to 90 degrees from straight down, or auto")
    return degrees


def _suggest_check(scene: Path, *, as_json: bool, drawn: Path | None = None) -> None:
    if not as_json:
        shown = f"{drawn} shows the poses; " if drawn else ""
        say(f"{shown}{command('scene', 'check', scene)} checks that poses, points and panoramas fit together")
