"""What runs have made: eval, render, view, report, compare, partition."""

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from panolog.orchestrator.cli.console import print_json, print_result, progress_bar, say
from panolog.orchestrator.cli.options import (
    BlocksOption,
    DeviceOption,
    FrameOption,
    JsonOption,
    ModelArg,
    PageOption,
    RunArg,
)
from panolog.orchestrator.cli.stores import opened
from panolog.orchestrator.cli.syntax import argument, flag, option
from panolog.scene.errors import InputError
from panolog.scene.stores.url import is_url

if TYPE_CHECKING:
    from panolog.export.site.page import Page


def evaluate(
    run: RunArg,
    as_json: JsonOption = False,
    model: Annotated[
        Path | None, option("FILE", "Evaluate this PLY, SOG or SPZ, not the run's model.")
    ] = None,
    frame: FrameOption = "export",
    crop_bottom: Annotated[
        float | None,
        option(
            "FRACTION",
            "Part of the height to leave out at the bottom (paper: 0.1). Default: as in the run.",
            min=0,
            max=0.99,
        ),
    ] = None,
    seams: Annotated[bool, flag("Also show what is seen of the faces between blocks.", "--seams")] = False,
    device: DeviceOption = None,
) -> None:
    """Measure the quality of a model on the held-out panoramas."""
    from panolog.orchestrator.runs.folder import RunFolder
    from panolog.orchestrator.runs.info import read_info

    read_info(RunFolder(run))  # fails before torch is imported
    with progress_bar("reading the run") as show:
        from panolog.orchestrator.cli.commands.evaluate import evaluate_run, lines

        report = evaluate_run(
            run,
            model=model,
            axes=frame,
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
    output: Annotated[Path, option("FOLDER", "Folder of the results.", "--output", "-o")],
    poses: Annotated[Path | None, option("FILE", "Pose list: JSON, COLMAP images.txt or TUM.")] = None,
    model: Annotated[Path | None, option("FILE", "Render this PLY, SOG or SPZ, not the run's model.")] = None,
    frame: FrameOption = "export",
    path: Annotated[int | None, option("FRAMES", "A smooth path along the run's panoramas.", min=2)] = None,
    width: Annotated[int | None, option("W", "Panoramas: width in pixels. Default: as in training.")] = None,
    fov: Annotated[float | None, option("DEGREES", "Perspective views of this horizontal angle.")] = None,
    size: Annotated[
        str | None, option("WxH", "Perspective views: size in pixels. Default: 16:9, as in training.")
    ] = None,
    yaw: Annotated[float | None, option("DEGREES", "Perspective views: turn to the right.")] = None,
    pitch: Annotated[float | None, option("DEGREES", "Perspective views: turn upwards.")] = None,
    mp4: Annotated[bool, flag("Write one video, FOLDER/video.mp4 (VP9), instead of PNGs.", "--mp4")] = False,
    fps: Annotated[int | None, option("N", "Video: frames per second. Default: 30.", min=1, max=240)] = None,
    device: DeviceOption = None,
) -> None:
    """Render pictures or a video of a model, from a pose list or along a path."""
    _require(source)
    if model is not None and not source.is_dir():
        raise InputError("--model needs the folder of a run, whose poses it is rendered from")
    if fps is not None and not mp4:
        raise InputError("--fps is of videos: give --mp4 too")
    with progress_bar("reading the model") as show:
        from panolog.orchestrator.cli.commands.render import FPS, parse_view, render_views

        view = parse_view(width, fov, size, yaw, pitch, (fps or FPS) if mp4 else None)
        written = render_views(
            source,
            output,
            view,
            model=model,
            axes=frame,
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
        float | None, option("SHARE", "τ_grad of eq. 11: gradient share that assigns a camera.", "--tau")
    ] = None,
    rho: Annotated[
        float | None, option("FACTOR", "ρ_tri of eq. 7: margin around the cameras.", "--rho")
    ] = None,
    output: Annotated[
        Path | None, option("FOLDER", "Write plan.json and plan.png to this folder.", "--output", "-o")
    ] = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """Recompute the partition of a run with other settings, without training."""
    from panolog.orchestrator.runs.folder import RunFolder
    from panolog.orchestrator.runs.info import read_info

    read_info(RunFolder(run))  # fails before torch is imported
    changes = {"blocks": blocks, "partition.tau_grad": tau, "partition.rho_tri": rho}
    with progress_bar("reading the run") as show:
        from panolog.orchestrator.cli.commands.repartition import repartition

        tried = repartition(run, changes, output, device=device, progress=show)
    print_result(tried.plan.to_json(), tried.lines(), as_json=as_json)


def view(
    source: ModelArg,
    task: Annotated[str | None, option("coarse|block/003", "Show the model of this task.")] = None,
    camera: Annotated[str | None, option("NAME", "Start at this panorama of the run, like 004.jpg.")] = None,
    output: Annotated[
        Path | None,
        option(
            "FOLDER|FILE.html",
            "Write the page instead of serving it: as a folder for any web server, or as one file.",
            "--output",
            "-o",
        ),
    ] = None,
    max_gaussians: Annotated[
        int | None,
        option(
            "N",
            "Show at most N Gaussians that are not sky: those that cover most."
            " Default: all; 1,000,000 in one file.",
            "--max-gaussians",
            min=1,
        ),
    ] = None,
    most: Annotated[int | None, typer.Option("--most", min=1, hidden=True)] = None,  # its former name
    up: Annotated[str | None, option("z|-y|X,Y,Z", "The direction up of a PLY. Default: -y.")] = None,
    port: Annotated[int, option("PORT", "Port to serve on; 0 = any free port.", min=0, max=65535)] = 0,
) -> None:
    """Show the model of a run, a block or a file in 3D, in the browser, until Ctrl-C."""
    _require_shown(source, output, of_run=task is not None or camera is not None, of_ply=up is not None)
    with ExitStack() as open_until_the_end:
        with progress_bar("reading the model") as show:
            from panolog.export.georeference import Georeference
            from panolog.orchestrator.cli.commands.models import say_missing_sky
            from panolog.orchestrator.cli.commands.view import SiteServer, serve, site_of, write_view
            from panolog.orchestrator.cli.export import direction_of
            from panolog.orchestrator.watch.views.site.build import Wanted
            from panolog.workers.tasks import TaskId

            say_missing_sky(source)
            place = None if up is None else Georeference(direction_of(up))
            wanted = Wanted(TaskId.parse(task) if task else None, camera, max_gaussians or most, place=place)
            if output is not None:
                page = write_view(source, wanted, output, show).page
                one = output.is_file()
                print(output.absolute().as_uri() if one else output)
                _say_count(page)
                return
            site = open_until_the_end.enter_context(site_of(source, wanted, show))
            server = SiteServer(site, port)
        print(server.url, flush=True)
        if site.shown is not None:
            _say_count(site.shown)
        _open_served(server.url, server.server_port)
        serve(server)


def _require_shown(source: Path, output: Path | None, *, of_run: bool, of_ply: bool) -> None:
    """Refuses what cannot be shown. Args: of_run, of_ply, whether options of these alone are given."""
    _require(source)
    from panolog.orchestrator.runs.folder import RunFolder, read_head

    if source.is_dir():
        read_head(RunFolder(source))
    elif of_run:
        raise InputError("--task and --camera need the folder of a run, not a file")
    if of_ply and source.suffix.lower() != ".ply":
        raise InputError("--up is of a PLY: what else is shown says itself where up is; leave it out")
    if output is not None and not output.absolute().parent.is_dir():
        raise InputError(f"{output.parent}: there is no such folder for the page")


def _open_served(url: str, port: int) -> None:
    """Opens a page that is served, or says how to reach it, and how to stop it.

    A browser for terminals could not show it, so on Linux there have to be windows.
    """
    import os
    import webbrowser

    windows = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")))
    if not (windows and webbrowser.open(url)):
        forward = f"ssh -L {port}:127.0.0.1:{port}"
        say(f"there is no browser here: open the address elsewhere after {forward}, or give -o FOLDER")
    say("Ctrl-C stops it")


def _say_count(page: "Page") -> None:
    """Says how many Gaussians a page shows; nothing of a file that only the browser reads."""
    shown = page.total if page.shown is None else page.shown
    part = f" of {page.total:,}" if shown < page.total else ""
    if page.total:
        say(f"{shown:,}{part} Gaussians")


def report(
    runs: Annotated[list[str], argument("RUN", "Folder or URL of a run; several folders are compared.")],
    output: PageOption = None,
) -> None:
    """Write a run as one page to share: RUN/report.html, or FILE.html; several, compared, as FILE.html."""
    from panolog.orchestrator.runs.folder import RunFolder

    if len(runs) > 1:
        if output is None:
            raise InputError("a report of several runs belongs to none of them: give -o FILE.html")
        if any(map(is_url, runs)):
            raise InputError("a report of several runs reads folders only; fetch them first")
        _write_comparison([Path(run) for run in runs], output)
        return
    if is_url(runs[0]) and output is None:
        raise InputError("a report of a run in a store: give -o FILE.html")
    with opened(runs[0], "report") as (root, _), progress_bar("writing the report"):
        from panolog.orchestrator.watch.views.pages.report import write_report

        page = write_report(RunFolder(root), output)
    print(page)


def compare(
    runs: Annotated[list[Path], argument("RUN", "Folders of two runs or more.")],
    as_json: JsonOption = False,
    output: PageOption = None,
) -> None:
    """Compare runs: settings that differ, sizes, times and metrics; with -o as one page to share."""
    from panolog.orchestrator.watch.views.comparison.compare import compare as compare_runs
    from panolog.orchestrator.watch.views.comparison.reading import picture_of, read_runs

    comparison = compare_runs(read_runs(runs), picture_of)
    if as_json:
        print_json(comparison.model_dump(mode="json"))
    else:
        from rich.console import Console

        from panolog.orchestrator.watch.views.comparison.terminal import table, width_of

        console = Console()
        if not console.is_terminal:  # a file or a pipe has no width
            console.width = max(console.width, width_of(comparison))
        console.print(table(comparison))
    if output is not None:
        _write_comparison(runs, output, quiet=as_json)


def _write_comparison(runs: list[Path], output: Path, *, quiet: bool = False) -> None:
    """Writes runs side by side as one page, and prints its path; `quiet` on stderr."""
    if not output.parent.is_dir():
        raise InputError(f"{output.parent}: there is no such folder for the page")
    with progress_bar("writing the page"):
        from panolog.orchestrator.watch.views.comparison.page import write_comparison

        write_comparison(runs, output)
    if quiet:
        say(str(output))
    else:
        print(output)


def _require(source: Path) -> None:
    """Raises InputError if there is no such run or PLY."""
    if not source.exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
