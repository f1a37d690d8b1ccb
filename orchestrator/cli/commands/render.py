"""`panolog render`: pictures or a video of a run's model, or of any PLY, at given poses."""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.export.frame import Frame
from panolog.orchestrator.cli.commands.models import Axes, as_ply, frame_in
from panolog.orchestrator.cli.console import say
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import read_info
from panolog.renderer.camera import Lens, facing, perspective
from panolog.renderer.poses import Pose, read_poses, smooth_path
from panolog.renderer.process import choose_device
from panolog.renderer.render import encode_png, render_panorama
from panolog.scene.errors import InputError, RunError
from panolog.scene.files import atomic, write_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Vector
from panolog.scene.ply import ply_exact, ply_offset, read_ply
from panolog.scene.write import StageProgress, no_progress

_WIDTH = 2048  # pixels of a panorama of a PLY without a run
_NARROWEST, _WIDEST = 640, 3840  # pixels of a perspective view whose size is not given
_BLURRED = 1.5  # times coarser than its pixels: then a view is said to be blurred
_VIDEO = "video.mp4"
FPS = 30  # frames per second of a video
# VP9: all current browsers and players show it, and the FFmpeg in OpenCV's wheels can write it. Encoders of
# H.264 are in no package of a licence that PanoLOG could depend on.
_CODEC = "vp09"

Image = NDArray[np.uint8]  # (H, W, 3) RGB


@dataclass(frozen=True)
class ViewSpec:
    """What to render at each pose: a panorama, or a perspective view in one direction of it."""

    width: int | None = None  # pixels of panoramas; None = as the run trained
    fov: float | None = None  # degrees of a perspective view, horizontal; None = panoramas
    size: tuple[int, int] | None = None  # pixels of a perspective view; None = as `lens_like`
    yaw: float = 0.0  # degrees to the right
    pitch: float = 0.0  # degrees up
    fps: int | None = None  # frames per second of a video; None = pictures

    def lens(self, panorama: int) -> Lens | None:
        """The lens of perspective views, where panoramas are so many pixels wide; None = panoramas.

        Raises ValueError if the field of view or the size is out of range.
        """
        if self.fov is None:
            return None
        return Lens(*self.size, self.fov) if self.size else lens_like(panorama, self.fov)


def lens_like(panorama: int, fov: float) -> Lens:
    """A lens of 16:9 that is as fine in its middle as a panorama of `panorama` pixels, 640 to 3840 wide.

    A panorama has panorama / 2π pixels per radian. Both sizes are even, as videos need them.
    Raises ValueError if the field of view is not between 0 and 180 degrees.
    """
    focal = panorama / (2 * math.pi)
    wide = 2 * focal * math.tan(math.radians(fov) / 2) if 0 < fov < 180 else math.nan
    width = min(max(wide, _NARROWEST), _WIDEST) if math.isfinite(wide) else _NARROWEST
    return Lens(2 * round(width / 2), 2 * round(width * 9 / 32), fov)


def parse_view(
    width: int | None,
    fov: float | None,
    size: str | None,
    yaw: float | None,
    pitch: float | None,
    fps: int | None,
) -> ViewSpec:
    """Checks the options of `panolog render`; size is like "1280x720". Raises InputError if they conflict."""
    if width is not None and (width < 2 or width % 2):
        raise InputError(f"--width {width}: a panorama's width must be even")
    if fov is None:
        if (size, yaw, pitch) != (None, None, None):
            raise InputError("--size, --yaw and --pitch are of perspective views: give --fov too")
        return ViewSpec(width, fps=fps)
    if width is not None:
        raise InputError("--width is of panoramas: with --fov give --size")
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size or "")
    if size is not None and match is None:
        raise InputError(f"--size {size}: write it like 1280x720")
    for name, angle in (("yaw", yaw), ("pitch", pitch)):
        if not math.isfinite(angle or 0):
            raise InputError(f"--{name} {angle}: write a number of degrees")
    pixels = (int(match[1]), int(match[2])) if match else None
    view = ViewSpec(None, fov, pixels, yaw or 0.0, pitch or 0.0, fps)
    try:
        view.lens(_WIDTH)
    except ValueError as error:
        raise InputError(f"--fov {fov:g}{f' --size {size}' if size else ''}: {error}") from error
    return view


def render_views(
    source: Path,
    output: Path,
    view: ViewSpec,
    *,
    model: Path | None = None,
    axes: Axes = "export",
    poses: Path | None,
    frames: int | None,
    device: str | None,
    progress: StageProgress = no_progress,
) -> list[Path]:
    """Renders a run (a folder) or a model from the poses of a file, or in `frames` along the run's panoramas.

    Poses of a file are in the coordinates of the scene's COLMAP model: a model that was trained nearer to the
    origin (`Scene.offset`) has in its PLY what to subtract.

    Args: model, shown instead of the run's; axes of it if it is no PLY. A model without a run is rendered in
    its own coordinates.
    Returns the paths of the PNGs below `output`, or of the one video.
    Raises InputError if the source, the poses, the output or the device cannot be used; RunError if the video
    cannot be encoded.
    """
    device = choose_device(device)
    job = _job(source) if source.is_dir() and not (source / "meta.json").is_file() else None
    file = model or (job.folder.point_cloud if job else source)
    exact = job is not None and ply_exact(job.folder.point_cloud)
    with as_ply(file, lambda: frame_in(file, job.scene, axes) if job else Frame(), exact=exact) as ply:
        shown = read_ply(ply).to(device)
        views = _poses(job, poses, frames, ply_offset(job.folder.point_cloud if job else ply))
    width = view.width or (job.width if job else _WIDTH)
    lens = view.lens(width)
    size = (lens.width, lens.height) if lens else (width, width // 2)
    if lens and (blur := 2 * math.pi * lens.focal / lens.panorama_width) > _BLURRED:
        say(
            f"blurred: {lens.width} pixels over {lens.fov:g} degrees are {blur:.1f} times as fine as the "
            "largest panorama that is rendered; "
            f"a view of {math.ceil(lens.width / blur)} pixels has the same detail"
        )
    if view.fps and (size[0] % 2 or size[1] % 2):
        raise InputError(f"a video cannot have {size[0]}x{size[1]} pixels: both must be even")
    paths = [output / _VIDEO] if view.fps else _paths(output, views)
    _make(output)
    draw = _drawer(shown, view, lens, width, job.near if job else 0.0)
    with _video(paths[0], size, view.fps) if view.fps else _pictures(paths) as write:
        for done, pose in enumerate(views):
            progress("rendering", done, len(views))
            write(draw(pose))
        progress("rendering", len(views), len(views))
    return paths


@contextmanager
def _pictures(paths: list[Path]) -> Iterator[Callable[[Image], None]]:
    """Yields the function that writes the next picture, as PNG."""
    left = iter(paths)
    yield lambda image: write_bytes(next(left), encode_png(image))


@contextmanager
def _video(path: Path, size: tuple[int, int], fps: int) -> Iterator[Callable[[Image], None]]:
    """Yields the function that appends a frame of `size` (width, height); the video appears at the end."""
    with atomic(path) as temporary:
        growing = temporary.with_name(f"{temporary.name}{path.suffix}")  # its suffix decides the format
        try:
            writer = cv2.VideoWriter(str(growing), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*_CODEC), fps, size)
            if not writer.isOpened():
                raise RunError(f"{path}: OpenCV cannot encode a video of {size[0]}x{size[1]} pixels here")

            written = 0

            def write(image: Image) -> None:
                nonlocal written
                # of OpenCV 5; 4 returns None
                if writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR)) is False:
                    raise RunError(f"{path}: a frame cannot be written; is the disk full?")
                written += 1

            yield write
            writer.release()  # says nothing if the disk is full
            if cv2.VideoCapture(str(growing)).get(cv2.CAP_PROP_FRAME_COUNT) != written:
                raise RunError(f"{path}: its end cannot be written; is the disk full?")
            growing.replace(temporary)
        finally:
            growing.unlink(missing_ok=True)


def _job(root: Path) -> Job:
    folder = RunFolder(root)
    info = read_info(folder)
    if not folder.point_cloud.exists():
        raise InputError(f"{root}: has no merged model yet; render its coarse/model.ply, or resume the run")
    return Job(folder, scene_of(info, folder), info.config).learnt


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
    """One PNG for each pose. Raises InputError if two poses share a name."""
    paths = [output / f"{pose.name.replace('/', '_')}.png" for pose in poses]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise InputError(f"two poses are named {twice.stem}: each needs another name")
    return paths


def _make(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be created: {error.strerror}") from error


def _drawer(
    model: Gaussians, view: ViewSpec, lens: Lens | None, width: int, near: float
) -> Callable[[Pose], Image]:
    """What renders a pose, as a panorama `width` pixels wide or through a lens."""
    if lens is None:
        return lambda pose: render_panorama(model, pose.rotation, pose.translation, width, near)
    direction = facing(view.yaw, view.pitch)

    def draw(pose: Pose) -> Image:
        panorama = render_panorama(model, pose.rotation, pose.translation, lens.panorama_width, near)
        return perspective(panorama, lens, direction)

    return draw
