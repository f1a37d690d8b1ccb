"""`panolog render`: pictures of a run's model, or of any PLY, at given poses."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from panolog.orchestrator.driver.job import Job, scene_of
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.renderer.camera import Lens, facing, perspective
from panolog.renderer.poses import Pose, read_poses, smooth_path
from panolog.renderer.process import choose_device
from panolog.renderer.render import encode_png, render_panorama
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Vector
from panolog.scene.ply import ply_offset, read_ply

_WIDTH = 2048  # pixels of a panorama of a PLY without a run


@dataclass(frozen=True)
class ViewSpec:
    """What to render at each pose: a panorama, or a perspective view in one direction of it."""

    width: int | None = None  # pixels of panoramas; None = as the run trained
    lens: Lens | None = None
    yaw: float = 0.0  # degrees to the right
    pitch: float = 0.0  # degrees up


def parse_view(
    width: int | None, fov: float | None, size: str | None, yaw: float | None, pitch: float | None
) -> ViewSpec:
    """Checks the options of `panolog render`; size is like "1280x720". Raises InputError if they conflict."""
    if width is not None and (width < 2 or width % 2):
        raise InputError(f"--width {width}: a panorama's width must be even")
    if fov is None:
        if (size, yaw, pitch) != (None, None, None):
            raise InputError("--size, --yaw and --pitch are of perspective views: give --fov too")
        return ViewSpec(width)
    if width is not None:
        raise InputError("--width is of panoramas: with --fov give --size")
    size = size or "1280x720"
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if match is None:
        raise InputError(f"--size {size}: write it like 1280x720")
    try:
        lens = Lens(int(match[1]), int(match[2]), fov)
    except ValueError as error:
        raise InputError(f"--fov {fov} --size {size}: {error}") from error
    return ViewSpec(None, lens, yaw or 0.0, pitch or 0.0)


def render_views(
    source: Path,
    output: Path,
    view: ViewSpec,
    *,
    poses: Path | None,
    frames: int | None,
    device: str | None,
) -> Iterator[Path]:
    """Renders a run (a folder) or a PLY from the poses of a file, or in `frames` along the run's panoramas.

    Poses of a file are in the coordinates of the scene's COLMAP model: a model that was trained nearer to the
    origin (`Scene.offset`) has in its PLY what to subtract.

    Yields the path of each PNG once it is written below `output`.
    Raises InputError if the source, the poses, the output or the device cannot be used.
    """
    device = choose_device(device)
    job = _job(source) if source.is_dir() else None
    ply = job.folder.point_cloud if job else source
    model = read_ply(ply).to(device)
    views = _poses(job, poses, frames, ply_offset(ply))
    paths = _paths(output, views)
    width = view.width or (job.width if job else _WIDTH)
    draw = _drawer(model, view, width, job.near if job else 0.0)
    for pose, path in zip(views, paths, strict=True):
        write_bytes(path, draw(pose))
        yield path


def _job(root: Path) -> Job:
    folder = RunFolder(root)
    info = read_info(folder)
    if not folder.point_cloud.exists():
        raise InputError(f"{root}: has no merged model yet; render its coarse/model.ply, or resume the run")
    return Job(folder, scene_of(info), info.config)


def _poses(job: Job | None, file: Path | None, frames: int | None, offset: Vector) -> list[Pose]:
    if (file is None) == (frames is None):
        raise InputError("give the poses: either --poses FILE or --path FRAMES")
    if file is not None:
        poses = read_poses(file)
        return [replace(it, translation=it.translation + it.rotation @ offset) for it in poses]
    if job is None:
        raise InputError("--path needs a run, whose panoramas it follows; for a PLY give --poses")
    return smooth_path(job.scene.panoramas, frames or 0)


def _paths(output: Path, poses: list[Pose]) -> list[Path]:
    """One PNG for each pose; makes the folder. Raises InputError if two poses share a name."""
    paths = [output / f"{pose.name.replace('/', '_')}.png" for pose in poses]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise InputError(f"two poses are named {twice.stem}: each needs another name")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be made: {error.strerror}") from error
    return paths


def _drawer(model: Gaussians, view: ViewSpec, width: int, near: float) -> Callable[[Pose], bytes]:
    lens = view.lens
    if lens is None:
        return lambda pose: encode_png(render_panorama(model, pose.rotation, pose.translation, width, near))
    direction = facing(view.yaw, view.pitch)

    def draw(pose: Pose) -> bytes:
        panorama = render_panorama(model, pose.rotation, pose.translation, lens.panorama_width, near)
        return encode_png(perspective(panorama, lens, direction))

    return draw
