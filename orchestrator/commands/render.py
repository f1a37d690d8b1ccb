"""`panolog render`: pictures of a run's model, or of any PLY, from poses that the user gives."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from panolog.orchestrator.driver.job import Job, scene_of
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.renderer.views import Lens, encode_png, facing, perspective, render_panorama
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import read_ply
from panolog.workers.poses import Pose, read_poses, smooth_path

_WIDTH = 2048  # pixels of a panorama of a PLY that comes without a run


@dataclass(frozen=True)
class Look:
    """How to look: a panorama, or with a lens in one direction of it."""

    width: int | None = None  # pixels of panoramas; None = as the run trained
    lens: Lens | None = None
    yaw: float = 0.0  # degrees to the right
    pitch: float = 0.0  # degrees up


def render_views(
    source: Path,
    output: Path,
    look: Look,
    *,
    poses: Path | None,
    frames: int | None,
    device: str,
) -> Iterator[Path]:
    """Renders a run (a folder) or a PLY from the poses of a file, or in `frames` along the run's panoramas.

    Yields the path of each PNG once it is written below `output`.
    Raises InputError if the source, the poses or the output will not do.
    """
    job = _job(source) if source.is_dir() else None
    model = read_ply(job.folder.point_cloud if job else source).to(device)
    views = _poses(job, poses, frames)
    paths = _paths(output, views)
    width = look.width or (job.width if job else _WIDTH)
    draw = _drawer(model, look, width, job.near if job else 0.0)
    for pose, path in zip(views, paths, strict=True):
        write_bytes(path, draw(pose))
        yield path


def parse_lens(size: str, fov: float) -> Lens:
    """A lens from a size like "1280x720" and degrees. Raises InputError if it cannot be."""
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if match is None:
        raise InputError(f"--size {size}: write it like 1280x720")
    try:
        return Lens(int(match[1]), int(match[2]), fov)
    except ValueError as error:
        raise InputError(f"--fov {fov} --size {size}: {error}") from error


def _job(root: Path) -> Job:
    folder = RunFolder(root)
    info = read_info(folder)
    if not folder.point_cloud.exists():
        raise InputError(f"{root}: has no merged model yet; render its coarse/model.ply, or resume the run")
    return Job(folder, scene_of(info), info.config)


def _poses(job: Job | None, file: Path | None, frames: int | None) -> list[Pose]:
    if (file is None) == (frames is None):
        raise InputError("say where to look from: either --poses FILE or --path FRAMES")
    if file is not None:
        return read_poses(file)
    if job is None:
        raise InputError("--path needs a run, whose panoramas it follows; for a PLY give --poses")
    return smooth_path(job.scene.panoramas, frames or 0)


def _paths(output: Path, poses: list[Pose]) -> list[Path]:
    """One PNG for each pose, with its folders made. Raises InputError if two poses share a name."""
    paths = [output / f"{pose.name.replace('/', '_')}.png" for pose in poses]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise InputError(f"two poses are named {twice.stem}: each needs a name of its own")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be made: {error.strerror}") from error
    return paths


def _drawer(model: Gaussians, look: Look, width: int, near: float) -> Callable[[Pose], bytes]:
    lens = look.lens
    if lens is None:
        return lambda pose: encode_png(render_panorama(model, pose.rotation, pose.translation, width, near))
    direction = facing(look.yaw, look.pitch)

    def draw(pose: Pose) -> bytes:
        panorama = render_panorama(model, pose.rotation, pose.translation, lens.panorama_width, near)
        return encode_png(perspective(panorama, lens, direction))

    return draw
