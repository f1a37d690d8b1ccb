"""What a run has made: eval, render, view, report, partition."""

from pathlib import Path
from typing import Annotated

import typer

from panolog.orchestrator.cli.console import print_result, progress_bar, say
from panolog.orchestrator.cli.options import (
    BlocksOption,
    DeviceOption,
    JsonOption,
    ModelArg,
    PageOption,
    RunArg,
    WidthOption,
)
from panolog.scene.errors import InputError


def evaluate(
    run: RunArg,
    as_json: JsonOption = False,
    model: Annotated[Path | None, typer.Option(metavar="PLY", help="Evaluate this model instead.")] = None,
    crop_bottom: Annotated[
        float | None, typer.Option(min=0, max=0.99, help="Fraction of the height to leave out (paper: 0.1).")
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Metrics on the held-out panoramas: PSNR, SSIM, LPIPS, WS-PSNR, WS-SSIM, Gaussians, bytes."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))  # fails before torch is imported
    from panolog.orchestrator.commands.evaluate import evaluate_run, lines

    with progress_bar(quiet=True) as show:
        report = evaluate_run(run, model=model, crop_bottom=crop_bottom, device=device, progress=show)
    print_result(report, lines(report), as_json=as_json)
    if report["lpips_reason"] and not as_json:
        say(report["lpips_reason"])


def render(
    source: ModelArg,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder of the PNGs.")],
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Pose list: JSON, COLMAP images.txt or TUM.")
    ] = None,
    path: Annotated[
        int | None, typer.Option(min=2, metavar="FRAMES", help="A smooth path along the run's panoramas.")
    ] = None,
    width: WidthOption = None,
    fov: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Perspective views of this horizontal angle.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Perspective views: size in pixels. Default: 1280x720.")
    ] = None,
    yaw: Annotated[float | None, typer.Option(help="Perspective views: degrees to the right.")] = None,
    pitch: Annotated[float | None, typer.Option(help="Perspective views: degrees up.")] = None,
    device: DeviceOption = None,
) -> None:
    """Render panoramas or perspective views of a model, from a pose list or along a path."""
    _require(source)
    from panolog.orchestrator.commands.render import parse_view, render_views

    view = parse_view(width, fov, size, yaw, pitch)
    count = sum(1 for _ in render_views(source, output, view, poses=poses, frames=path, device=device))
    say(f"{count} pictures in {output}")


def partition(
    run: RunArg,
    blocks: BlocksOption = None,
    tau: Annotated[float | None, typer.Option("--tau", help="τ_grad of eq. 11.")] = None,
    rho: Annotated[float | None, typer.Option("--rho", help="ρ_tri of eq. 7.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Write the plan's files here.")
    ] = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """Recompute the plan of a run with other parameters, without training."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))  # fails before torch is imported
    from panolog.orchestrator.commands.repartition import lines, repartition

    changes = {"blocks": blocks, "partition.tau_grad": tau, "partition.rho_tri": rho}
    with progress_bar(quiet=True) as show:
        plan = repartition(run, changes, output, device=device, progress=show)
    print_result(plan.to_json(), lines(plan), as_json=as_json)


def view(
    source: ModelArg,
    task: Annotated[
        str | None, typer.Option(metavar="coarse|block/003", help="Show the current model of this task.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Start at this panorama of the run, like 004.jpg."),
    ] = None,
    output: PageOption = None,
    most: Annotated[
        int | None, typer.Option(min=1, help="Gaussians to show, those that cover most. Default: 500,000.")
    ] = None,
) -> None:
    """Show a model in 3D in the browser: of a run, live or ended, of one of its blocks, or of a PLY."""
    _require(source)
    from panolog.orchestrator.run.folder import RunFolder, read_head

    folder = RunFolder(source) if source.is_dir() else None
    if folder is not None:
        read_head(folder)
    elif task is not None or camera is not None:
        raise InputError("--task and --camera need the folder of a run, not a PLY")
    import webbrowser
    from tempfile import mkdtemp

    from panolog.orchestrator.views.model_page import MOST, write_page, write_run_page
    from panolog.workers.tasks import TaskId

    page = output or Path(mkdtemp(prefix="panolog-view-")) / "view.html"
    if folder is not None:
        chosen = TaskId.parse(task) if task else None
        shown = write_run_page(folder, chosen, page, camera=camera, most=most or MOST)
    else:
        shown = write_page(source, page, title=source.name, most=most or MOST)
    say(f"{len(shown):,} Gaussians in {page}")
    if output is None:
        webbrowser.open(page.as_uri())


def report(run: RunArg, output: PageOption = None) -> None:
    """Write a run, live or ended, as one page: RUN/report.html unless --output is given."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.views.report import write_report

    print(write_report(RunFolder(run), output))


def _require(source: Path) -> None:
    """Raises InputError if there is no such run or PLY."""
    if not source.exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
