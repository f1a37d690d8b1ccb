"""The commands that make a scene: from what a camera gives to what `panolog run` takes."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import typer

from panolog.orchestrator.cli.app import JsonOption, SceneArg, err, print_json, say
from panolog.orchestrator.cli.tools import scene_app
from panolog.scene.errors import InputError

_LINES = 15.0  # seconds between two plain lines where no bar can move

ModelOption = Annotated[
    Path, typer.Option("--model", metavar="M.onnx", help="The network, with its manifest M.yaml beside it.")
]
NetworkDeviceOption = Annotated[
    str, typer.Option("--device", metavar="auto|cpu|cuda|tensorrt", help="Where the network runs.")
]
BatchOption = Annotated[int, typer.Option(min=1, max=1024, help="Pictures that the network gets at once.")]


@scene_app.command("depth")
def scene_depth(
    scene: SceneArg,
    model: ModelOption,
    batch: BatchOption = 2,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Depth maps and sky masks by an ONNX network, and how they fit the sparse points."""
    from panolog.prepare.networks.depth_maps import make_depth, plan_depth
    from panolog.prepare.networks.depth_report import align_depth_maps
    from panolog.prepare.networks.depth_summary import report
    from panolog.prepare.panorama_files import list_posed_panoramas
    from panolog.scene.read import read_scene

    job = plan_depth(list_posed_panoramas(scene), model, device)
    say(f"{len(job.todo)} panoramas on {job.network.device}; {job.done} are done, {job.given} maps are given")
    with steps("depth") as step:
        for made in make_depth(job, batch):
            step(made)
    with steps("alignment") as step:
        rows = []
        for row in align_depth_maps(read_scene(scene)):
            rows.append(row)
            step(row)
    described = report(job, rows)
    if as_json:
        print_json(described.as_json())
        return
    for line in described.lines():
        print(line)


@scene_app.command("mask")
def scene_mask(
    scene: SceneArg,
    nadir: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Ignore what is so close to straight down.")
    ] = None,
    static: Annotated[
        bool,
        typer.Option("--static", help="Ignore what stays the same around the nadir: who carries the camera."),
    ] = False,
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="M.onnx", help="Ignore what this network finds, with its manifest M.yaml beside it."
        ),
    ] = None,
    batch: BatchOption = 2,
    device: NetworkDeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Masks of the operator, the tripod and movers, combined with those that are there."""
    if nadir is None and not static and model is None:
        raise InputError(
            "nothing to mask: give --nadir DEGREES, --static or --model M.onnx, or several of them"
        )
    if nadir is not None and not 0 < nadir <= 90:
        raise InputError(f"--nadir {nadir:g}: give an angle from straight down, above 0 and up to 90 degrees")
    from panolog.prepare.networks.mask_summary import lines, report
    from panolog.prepare.networks.masks import MaskJob, find_static, make_masks, open_mover_network
    from panolog.prepare.panorama_files import list_panoramas

    pictures = list_panoramas(scene)
    movers = open_mover_network(model, device, batch) if model is not None else None
    region = None
    if static:
        with steps("static regions") as step:
            region = find_static(pictures, step)
    masks = []
    with steps("masks") as step:
        for masked in make_masks(pictures, MaskJob(nadir, region, movers)):
            masks.append(masked)
            step(masked)
    described = report(masks, region)
    if as_json:
        print_json(described)
        return
    for line in lines(described):
        print(line)


@scene_app.command("sfm")
def scene_sfm(
    source: Annotated[
        Path, typer.Argument(metavar="IMAGES|VIDEO", help="Folder of panoramas, or a 360° video.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="SCENE", help="Folder of the new scene.")],
    pairs: Annotated[
        Literal["auto", "exhaustive", "sequential"], typer.Option(help="Which panoramas are matched.")
    ] = "auto",
    mapper: Annotated[
        Literal["incremental", "global"], typer.Option(help="How the poses are found.")
    ] = "incremental",
    parallax: Annotated[
        float | None, typer.Option(metavar="DEGREES", help="Of a video: between one frame and the next.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=2, help="Of a video: how many at most.")] = None,
    distance: Annotated[
        tuple[str, str, float] | None,
        typer.Option(metavar="NAME NAME METRES", help="How far two panoramas are apart, for the scale."),
    ] = None,
    gps: Annotated[bool, typer.Option(help="Take metres and north from the GPS in EXIF.")] = True,
    partial: Annotated[
        bool, typer.Option("--partial", help="Half of the panoramas or fewer will do.")
    ] = False,
    link: Annotated[bool, typer.Option("--link", help="Link the panoramas instead of copying them.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Poses and points for raw panoramas or a 360° video: a scene for `panolog run`."""
    from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
    from panolog.prepare.sfm.report import report, write_report
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
    with stages() as hear:
        made = make_scene(source, output, settings, hear)
    described = report(made)
    write_report(output, described)
    if as_json:
        print_json({"scene": str(output), **described.as_json()})
        return
    for line in described.lines():
        print(line)
    say(f"{output / 'sfm.png'} shows where they stand; `panolog scene check {output}` tells whether they fit")


@scene_app.command("import")
def scene_import(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of another program.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="SCENE", help="Folder of the new scene.")],
    format: Annotated[
        str | None, typer.Option(metavar="NAME", help="Its format, if it cannot be told (docs/import.md).")
    ] = None,
    images: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Where the panoramas are, if elsewhere.")
    ] = None,
    points: Annotated[
        Path | None, typer.Option(metavar="PLY", help="The point cloud, if elsewhere or missing.")
    ] = None,
    link: Annotated[bool, typer.Option("--link", help="Link the panoramas instead of copying them.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A scene of openMVG, OpenSfM, nerfstudio, Metashape, SphereSfM and others as one of ours."""
    from panolog.prepare.importers.import_scene import import_scene
    from panolog.prepare.importers.interface import ImportSource

    with steps("import", kept=False) as step:
        report = import_scene(
            ImportSource(source, images, points),
            output,
            format=format,
            link=link,
            progress=lambda done, total: step(Count(done, total)),
        )
    if as_json:
        print_json({"scene": str(output), **asdict(report)})
        return
    for note in report.notes:
        say(note)
    print(
        f"{output}: {report.panoramas} panoramas, {report.points:,} points, "
        f"{report.observations:,} observations, from {report.format}"
    )
    say(f"`panolog scene check {output}` tells whether they fit")


@scene_app.command("check")
def scene_check(scene: SceneArg, as_json: JsonOption = False) -> None:
    """Whether poses, points and panoramas fit: axes, handedness, names, pixel convention."""
    from panolog.prepare.check.diagnosis import check_scene
    from panolog.scene.read import read_scene

    verdict = check_scene(read_scene(scene))
    if as_json:
        print_json(verdict.as_json())
    else:
        for line in verdict.lines():
            print(line)
        for problem in verdict.problems:
            print(f"WRONG   {problem}")
    if verdict.problems:
        raise typer.Exit(2)


@dataclass(frozen=True)
class Count:
    """A `Step` of work that only counts."""

    iteration: int
    iterations: int


class Step(Protocol):
    """What long work tells now and then."""

    @property
    def iteration(self) -> int:
        """Done so far."""

    @property
    def iterations(self) -> int:
        """To be done in all."""


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """As `steps`, for work that says what it is doing: a line for each thing begun, and its progress."""
    with ExitStack() as stack:
        now, step = "", None

        def hear(what: str, done: int, total: int) -> None:
            nonlocal now, step
            if step is None or what != now:
                stack.close()
                now, step = what, stack.enter_context(steps(what))
            step(Count(done, total))

        yield hear


@contextmanager
def steps(what: str, *, kept: bool = True) -> Iterator[Any]:
    """Progress on stderr: a bar on a terminal, elsewhere a line now and then.

    What it yields is to be called with each `Step`. Ctrl-C says that nothing is lost, unless it is not
    `kept`, and goes on to the one place that ends the program.
    """
    from rich.progress import Progress

    last = time.monotonic()
    with Progress(console=err(), transient=True, disable=not err().is_terminal) as bars:
        task = bars.add_task(what, total=None)

        def hear(step: Step) -> None:
            nonlocal last
            bars.update(task, completed=step.iteration, total=step.iterations)
            if not err().is_terminal and (
                time.monotonic() - last > _LINES or step.iteration == step.iterations
            ):
                last = time.monotonic()
                say(f"{what}: {step.iteration} of {step.iterations}")

        try:
            yield hear
        except KeyboardInterrupt:
            if kept:
                say(f"{what}: what is done is kept; the same command goes on from there")
            raise
