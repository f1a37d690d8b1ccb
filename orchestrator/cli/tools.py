"""The commands beside the run itself: looking at models, plans, scenes and machines."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from panolog.orchestrator.cli.app import (
    AddressOption,
    BlocksOption,
    ConfigOption,
    DeviceOption,
    IterationsOption,
    JsonOption,
    RunArg,
    SceneArg,
    SetOption,
    WidthOption,
    app,
    err,
    print_json,
    say,
    tell_end,
)
from panolog.scene.errors import InputError

scene_app = typer.Typer(no_args_is_help=True, help="Look at a scene.")
app.add_typer(scene_app, name="scene")


@app.command("eval")
def evaluate(
    run: RunArg,
    as_json: JsonOption = False,
    model: Annotated[Path | None, typer.Option(metavar="PLY", help="Judge this model instead.")] = None,
    crop_bottom: Annotated[
        float | None, typer.Option(min=0, max=0.99, help="Fraction of the height left out (the paper: 0.1).")
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Metrics on the held-out panoramas: PSNR, SSIM, LPIPS, WS-PSNR, WS-SSIM, Gaussians, bytes."""
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))
    from panolog.orchestrator.commands.evaluate import judge

    with _progress("eval") as hear:
        report = judge(run, model=model, crop_bottom=crop_bottom, device=_device(device), hear=hear)
    if as_json:
        print_json(report)
        return
    from panolog.orchestrator.views.progress import metrics_line

    for name, metrics in report["views"].items():
        print(f"{name}: {metrics_line(metrics)}")
    print(f"mean: {metrics_line(report['mean'])}")
    print(f"{report['gaussians']:,} Gaussians, {report['bytes']:,} bytes")
    if report["lpips_reason"]:
        say(report["lpips_reason"])


@app.command()
def render(
    source: Annotated[Path, typer.Argument(metavar="RUN|PLY", help="Folder of a run, or a PLY.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where the PNGs go.")],
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Pose list: JSON, COLMAP images.txt or TUM.")
    ] = None,
    path: Annotated[
        int | None, typer.Option(min=2, metavar="FRAMES", help="A smooth path along the run's panoramas.")
    ] = None,
    width: Annotated[int | None, typer.Option(metavar="W", min=2, help="Of panoramas, in pixels.")] = None,
    fov: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Perspective views of this horizontal angle.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Of perspective views, in pixels: 1280x720 unless given."),
    ] = None,
    yaw: Annotated[float | None, typer.Option(help="Of perspective views, degrees to the right.")] = None,
    pitch: Annotated[float | None, typer.Option(help="Of perspective views, degrees up.")] = None,
    device: DeviceOption = None,
) -> None:
    """Panoramas or perspective views of a model, from a pose list or along a path."""
    if not source.exists():
        raise InputError(f"{source}: there is neither a run nor a PLY")
    if width is not None and width % 2:
        raise InputError(f"--width {width}: a panorama's width must be even")
    if fov is None and (size, yaw, pitch) != (None, None, None):
        raise InputError("--size, --yaw and --pitch are of perspective views: give --fov too")
    if fov is not None and width is not None:
        raise InputError("--width is of panoramas: with --fov give --size")
    from panolog.orchestrator.commands.render import Look, parse_lens, render_views

    look = Look(width, None if fov is None else parse_lens(size or "1280x720", fov), yaw or 0.0, pitch or 0.0)
    count = 0
    for _ in render_views(source, output, look, poses=poses, frames=path, device=_device(device)):
        count += 1
    say(f"{count} pictures in {output}")


@app.command()
def partition(
    run: RunArg,
    blocks: Annotated[str | None, typer.Option(metavar="3x2x1|auto", help="Blocks along x, y and z.")] = None,
    tau: Annotated[float | None, typer.Option(help="τ_grad of eq. 11.")] = None,
    rho: Annotated[float | None, typer.Option(help="ρ_tri of eq. 7.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="Write the plan's files here.")
    ] = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """The plan of a run again with other parameters, as a what-if, without training."""
    from panolog.orchestrator.run.config import RunConfig, change
    from panolog.orchestrator.run.folder import RunFolder
    from panolog.orchestrator.run.info import read_info

    read_info(RunFolder(run))
    flags = {"blocks": blocks, "partition.tau_grad": tau, "partition.rho_tri": rho}

    def changed(config: RunConfig) -> RunConfig:
        return change(config, flags)

    from panolog.orchestrator.commands.repartition import plan_again
    from panolog.partition.audit import audit

    with _progress("score") as hear:
        plan = plan_again(run, changed, output, device=_device(device), hear=hear)
    if as_json:
        print_json(plan.to_json())
        return
    for block in plan.to_json()["blocks"]:
        cameras = len(block["cameras"])
        print(f"block {block['block']}: {cameras} cameras, {block['gaussians']:,} Gaussians")
    for line in audit(plan):
        print(line)


@scene_app.command("info")
def scene_info(scene: SceneArg, as_json: JsonOption = False) -> None:
    """What is in a scene, and whether it is sound."""
    from panolog.orchestrator.commands.scene_info import describe, lines
    from panolog.scene.read import read_scene

    description = describe(read_scene(scene))
    if as_json:
        print_json(description)
        return
    for line in lines(description):
        print(line)


@app.command()
def doctor(
    scene: Annotated[Path | None, typer.Argument(metavar="[SCENE]", help="Also check what it needs.")] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    blocks: BlocksOption = None,
    iterations: IterationsOption = None,
    width: WidthOption = None,
    device: DeviceOption = None,
    address: AddressOption = None,
    as_json: JsonOption = False,
) -> None:
    """What this machine has, what the job needs, what is missing and how to mend it."""
    from panolog.orchestrator.commands import doctor as doctoring
    from panolog.orchestrator.run.config import load_config

    flags = {"blocks": blocks, "iterations": iterations, "width": width, "device": device}
    resolved = load_config(config, settings or (), flags)
    findings, preflight = doctoring.examine(), None
    if scene is not None and not any(finding.fatal for finding in findings):
        from panolog.orchestrator.commands import session
        from panolog.orchestrator.commands.doctor_job import examine_job

        found, preflight = session.look(scene, resolved, address)
        findings += examine_job(found, preflight)
    if as_json:
        print_json(doctoring.as_json(findings, preflight.as_json() if preflight else None))
    else:
        for finding in findings:
            mark = "ok" if finding.ok else "MISSING" if finding.fatal else "note"
            print(f"{mark:8}{finding.what}: {finding.value}" + (f"; {finding.mend}" if finding.mend else ""))
    if any(finding.fatal for finding in findings):
        raise typer.Exit(2)


@app.command()
def demo(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="RUN", help="Folder of the run; the town lies beside it."),
    ] = Path("runs/demo"),
    address: AddressOption = None,
) -> None:
    """The whole job on a small town it makes itself: minutes on two CPU cores."""
    from panolog.orchestrator.commands.demo import demo as run_demo
    from panolog.orchestrator.views.progress import progress

    def town(done: int, total: int) -> None:
        if done in (1, total):
            say(f"a small town: {done} of {total} panoramas")

    with progress(err()) as show:
        state = run_demo(output, address, show, town)
    tell_end(output, state)


class _Step(Protocol):
    iteration: int
    iterations: int


@contextmanager
def _progress(what: str) -> Iterator[Any]:
    """A bar on stderr for one task in this process; nothing where nobody can see it move."""
    from rich.progress import Progress

    with Progress(console=err(), transient=True, disable=not err().is_terminal) as bars:
        task = bars.add_task(what, total=None)

        def hear(step: _Step) -> None:
            bars.update(task, completed=step.iteration, total=step.iterations)

        yield hear


def _device(wanted: str | None) -> str:
    """The device for work in this process. Raises InputError if it is unknown or missing."""
    from panolog.renderer.process import choose_device

    return choose_device(wanted)
