"""What a run has made: eval, render, view, report, partition."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.console import print_result, progress_bar, say
from panolog.orchestrator.cli.options import (
    BlocksOption,
    DeviceOption,
    FrameOption,
    JsonOption,
    ModelArg,
    PageOption,
    RunArg,
    axes_of,
)
from panolog.scene.errors import InputError


def evaluate(
    run: RunArg,
    as_json: JsonOption = False,
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Evaluate this PLY, SOG or SPZ, not the run's model.")
    ] = None,
    frame: FrameOption = "export",
    crop_bottom: Annotated[
        float | None,
        typer.Option(
            metavar="FRACTION",
            min=0,
            max=0.99,
            help="Part of the height to leave out at the bottom (paper: 0.1). Default: as in the run.",
        ),
    ] = None,
    seams: Annotated[
        bool, typer.Option("--seams", help="Also show what is seen of the faces between blocks.")
    ] = False,
    device: DeviceOption = None,
) -> None:
    """Measure the quality of a model on the held-out panoramas."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))  # fails before torch is imported
    with progress_bar("reading the run") as show:
        from panolog.orchestrator.commands.evaluate import evaluate_run, lines

        report = evaluate_run(
            run,
            model=model,
            axes=axes_of(frame),
            crop_bottom=crop_bottom,
            seams=seams,
            device=device,
            progress=show,
        )
    print_result(report, lines(report), as_json=as_json)
    if report["lpips_reason"] and not as_json:
        say(report["lpips_reason"])


def render(
    source: ModelArg,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder of the results.")],
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Pose list: JSON, COLMAP images.txt or TUM.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Render this PLY, SOG or SPZ, not the run's model.")
    ] = None,
    frame: FrameOption = "export",
    path: Annotated[
        int | None, typer.Option(min=2, metavar="FRAMES", help="A smooth path along the run's panoramas.")
    ] = None,
    width: Annotated[
        int | None, typer.Option(metavar="W", help="Panoramas: width in pixels. Default: as in training.")
    ] = None,
    fov: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Perspective views of this horizontal angle.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Perspective views: size in pixels. Default: 16:9, as in training."),
    ] = None,
    yaw: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Perspective views: turn to the right.")
    ] = None,
    pitch: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Perspective views: turn upwards.")
    ] = None,
    mp4: Annotated[
        bool, typer.Option("--mp4", help="Write one video, FOLDER/video.mp4 (VP9), instead of PNGs.")
    ] = False,
    fps: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, max=240, help="Video: frames per second. Default: 30."),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Render pictures or a video of a model, from a pose list or along a path."""
    _require(source)
    if model is not None and not source.is_dir():
        raise InputError("--model needs the folder of a run, whose poses it is rendered from")
    if fps is not None and not mp4:
        raise InputError("--fps is of videos: give --mp4 too")
    with progress_bar("reading the model") as show:
        from panolog.orchestrator.commands.render import FPS, parse_view, render_views

        view = parse_view(width, fov, size, yaw, pitch, (fps or FPS) if mp4 else None)
        written = render_views(
            source,
            output,
            view,
            model=model,
            axes=axes_of(frame),
            poses=poses,
            frames=path,
            device=device,
            progress=show,
        )
    say(f"{written[0]}" if mp4 else f"{len(written)} pictures in {output}")


def partition(
    run: RunArg,
    blocks: BlocksOption = None,
    tau: Annotated[
        float | None,
        typer.Option(
            "--tau", metavar="SHARE", help="τ_grad of eq. 11: gradient share that assigns a camera."
        ),
    ] = None,
    rho: Annotated[
        float | None,
        typer.Option("--rho", metavar="FACTOR", help="ρ_tri of eq. 7: margin around the cameras."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FOLDER", help="Write plan.json and plan.png to this folder."),
    ] = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """Recompute the partition of a run with other settings, without training."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))  # fails before torch is imported
    changes = {"blocks": blocks, "partition.tau_grad": tau, "partition.rho_tri": rho}
    with progress_bar("reading the run") as show:
        from panolog.orchestrator.commands.repartition import repartition

        tried = repartition(run, changes, output, device=device, progress=show)
    print_result(tried.plan.to_json(), tried.lines(), as_json=as_json)


def view(
    source: ModelArg,
    task: Annotated[
        str | None, typer.Option(metavar="coarse|block/003", help="Show the model of this task.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Start at this panorama of the run, like 004.jpg."),
    ] = None,
    output: PageOption = None,
    max_gaussians: Annotated[
        int | None,
        typer.Option(
            "--max-gaussians",
            metavar="N",
            min=1,
            help="Show at most N Gaussians, those that cover most. Default: 500,000.",
        ),
    ] = None,
    most: Annotated[int | None, typer.Option("--most", min=1, hidden=True)] = None,  # its former name
) -> None:
    """Show the model of a run, a block or a PLY in 3D, in the browser."""
    _require(source)
    from panolog.orchestrator.run.folder import RunFolder, read_head

    folder = RunFolder(source) if source.is_dir() else None
    if folder is not None:
        read_head(folder)
    elif task is not None or camera is not None:
        raise InputError("--task and --camera need the folder of a run, not a PLY")
    if output is not None and not output.parent.is_dir():
        raise InputError(f"{output.parent}: there is no such folder for the page")
    from tempfile import mkdtemp

    with progress_bar("writing the page"):
        from panolog.orchestrator.views.model_page import MOST, write_page, write_run_page
        from panolog.workers.tasks import TaskId

        page = output or Path(mkdtemp(prefix="panolog-view-")) / "view.html"
        limit = max_gaussians or most or MOST
        if folder is not None:
            chosen = TaskId.parse(task) if task else None
            shown = write_run_page(folder, chosen, page, camera=camera, most=limit)
        else:
            shown = write_page(source, page, title=source.name, most=limit)
    url = page.absolute().as_uri()
    print(url)
    part = f" of {shown.total:,}" if len(shown) < shown.total else ""
    say(f"{len(shown):,}{part} Gaussians")
    if output is None and not _open(url):
        say("there is no browser here: copy the page to another machine, or use panolog dashboard remotely")


def _open(url: str) -> bool:
    """Opens a page in a browser with windows; one for terminals could not show it. False if there is none."""
    import os
    import webbrowser

    windows = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")))
    return windows and webbrowser.open(url)


def report(run: RunArg, output: PageOption = None) -> None:
    """Write a run as one page to share: RUN/report.html, or FILE.html."""
    from panolog.orchestrator.run.folder import RunFolder

    with progress_bar("writing the report"):
        from panolog.orchestrator.views.report import write_report

        page = write_report(RunFolder(run), output)
    print(page)


def _require(source: Path) -> None:
    """Raises InputError if there is no such run or PLY."""
    if not source.exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
