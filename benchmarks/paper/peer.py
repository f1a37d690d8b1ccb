"""OpenSplat on the same panoramas, as faces of a cube: its quality over seconds next to ours.

It trains on the faces of the training panoramas alone; the models that it saves on its way are rendered by
our rasterizer at the held-out panoramas, after it has ended. Masks are not known to it, and it has no sky
sphere.
"""

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.measure import Gallery, haze
from benchmarks.paper.results import METRICS, Point, Result
from benchmarks.paper.tables import PEER
from benchmarks.paper.variants import POINTS
from benchmarks.rasterizer.peers import FACES, face
from panolog.renderer.camera import Lens, facing, perspective
from panolog.scene.errors import InputError, RunError
from panolog.scene.images import load_view
from panolog.scene.ply import read_ply

_JPEG = 98  # quality of the faces
_SCHEDULES = {  # its defaults, in iterations of its default length; ours scale with the length too
    "--resolution-schedule": 3000,  # it begins at a quarter of the width and doubles it twice
    "--sh-degree-interval": 1000,
    "--refine-every": 100,  # its opacity resets count these
    "--warmup-length": 500,
    "--stop-screen-size-at": 4000,
}
_FULL = 30_000  # that length


@dataclass(frozen=True)
class Face:
    """A pinhole image with its pose, world-to-camera."""

    name: str
    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,)


def check(binary: Path) -> None:
    """Raises InputError if there is no such program."""
    if not binary.is_file():
        raise InputError(f"--opensplat {binary}: there is no such file; give the program of its build")


def write_faces(gallery: Gallery, folder: Path) -> int:
    """Writes the faces of the training panoramas as a COLMAP project; returns their number.

    They are as fine in their middle as the panoramas at their equator, and 96 degrees wide.
    """
    lens, scene = face(gallery.width), gallery.scene
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    faces = []
    for row in scene.train:
        panorama = scene.panoramas[row]
        picture = load_view(panorama, row, gallery.width).image.numpy()
        for number, turn in enumerate(FACES):
            into = facing(*turn).T  # from the panorama's axes to those of the face
            name = f"{row:05d}_{number}.jpg"
            pixels = cv2.cvtColor(perspective(picture, lens, facing(*turn)), cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(images / name), pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG])
            faces.append(Face(name, into @ panorama.rotation, into @ panorama.translation))
    write_model(folder / "sparse" / "0", faces, lens, scene.points, scene.colors)
    return len(faces)


def write_model(
    folder: Path,
    faces: Sequence[Face],
    lens: Lens,
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
) -> None:
    """A binary COLMAP model with one PINHOLE camera; points have no observations, which OpenSplat skips."""
    import pycolmap  # noqa: PLC0415 (slow and large: loaded where a model is written)

    focal, width, height = lens.focal, lens.width, lens.height
    params = [focal, focal, width / 2, height / 2]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=params)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for number, item in enumerate(faces, start=1):
        image = pycolmap.Image(item.name, np.zeros((0, 2)), camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(item.rotation), item.translation)
        model.add_image_with_trivial_frame(image, pose)
    for point, color in zip(points, colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))


def train(binary: Path, gallery: Gallery, folder: Path, iterations: int, seconds: float) -> Result:
    """Trains it for so many iterations, or until the time is over, and evaluates what it has saved.

    Args: folder, for project and models, made anew; seconds, after which it is ended.
    Raises RunError if it fails or saves nothing.
    """
    if folder.exists():
        rmtree(folder)
    count = write_faces(gallery, folder / "project")
    every = max(1, iterations // (2 * POINTS))
    command = [str(binary.absolute()), str((folder / "project").absolute()), "-n", str(iterations)]
    command += ["-o", str((folder / "splat.ply").absolute()), "-s", str(every), "--keep-crs"]
    command += schedules(iterations)
    command += [] if gallery.device == "cuda" else ["--cpu"]
    print("$", *command, file=sys.stderr, flush=True)
    saved, ended = _watch(command, folder, seconds)
    if not saved:
        raise RunError(f"{binary} has saved no model in {folder}; see its output above")
    final = max(saved, key=lambda path: saved[path])
    curve = []
    for path, when in sorted(saved.items(), key=lambda item: item[1]):
        model = read_ply(path)
        metrics = gallery.quality(model)
        curve.append(Point(when, metrics["ws_psnr"] or 0.0, "merged" if path == final else "block"))
    return Result(
        gallery.scene.root.name,
        PEER,
        0,
        iterations=iterations,
        metrics={name: metrics.get(name) for name in METRICS},
        gaussians=len(model),
        bytes=final.stat().st_size,
        haze=haze(model),
        seconds={"coarse": saved[final]},
        curve=tuple(curve),
        notes=(f"{count} faces of 96°; {ended}; its own start counts; rendered by our rasterizer",),
    )


def schedules(iterations: int) -> list[str]:
    """Options that shorten its schedules as much as the run: else a short one sees no full image."""
    scaled = ((name, max(1, round(steps * iterations / _FULL))) for name, steps in _SCHEDULES.items())
    return [word for name, steps in scaled for word in (name, str(steps))]


def _watch(command: Sequence[str], folder: Path, seconds: float) -> tuple[dict[Path, float], str]:
    """Seconds from the start at which each model was whole, and how the program ended."""
    start = time.time()
    with subprocess.Popen(command, stdout=sys.stderr, cwd=folder) as process:
        late = False
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            late = True
        finally:
            process.terminate()
    if process.returncode and not late:
        raise RunError(f"{command[0]} ended with {process.returncode}")
    saved = {path: path.stat().st_mtime - start for path in sorted(folder.glob("splat*.ply"))}
    if late and saved:  # the last one may not be whole
        saved.pop(max(saved, key=lambda path: saved[path]))
    return saved, f"ended after {seconds:.0f} s" if late else "all iterations"
