"""COLMAP models of panoramas, read and written through pycolmap."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap_check import EQUIRECTANGULAR, PINHOLE, SPHERE, RawCamera, check_model, model_suffix
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic

if TYPE_CHECKING:
    import pycolmap

Observations = tuple[NDArray[np.int64], NDArray[np.float64]]  # (M,) rows of the points, (M, 2) pixels


@dataclass(frozen=True, eq=False)
class Model:
    """Posed images and a sparse cloud; poses are world-to-camera, images sorted by name."""

    names: tuple[str, ...]  # relative to the image folder
    rotations: NDArray[np.float64]  # (K, 3, 3)
    translations: NDArray[np.float64]  # (K, 3)
    observed: tuple[NDArray[np.int64], ...]  # K of (M,): the rows of points that the image sees, ascending
    points: NDArray[np.float64]  # (P, 3)
    colors: NDArray[np.uint8]  # (P, 3) RGB


def read_model(folder: Path) -> Model:
    """Reads cameras, images and points3D (.bin or .txt; rigs and frames may be there) from `folder`.

    A panorama is an EQUIRECTANGULAR camera, SphereSfM's SPHERE (which projects alike), or the dummy
    `PINHOLE W H W H W/2 H/2` of Pano360.

    Raises:
        SceneError: the model is damaged, its poses are broken or its cameras are not panoramas.
        OSError: a file of it cannot be read.
    """
    import pycolmap  # noqa: PLC0415 (slow and large: only who reads or writes a model pays for it)

    cameras = check_model(folder)
    for camera in cameras:
        _check_panorama(folder, camera)
    with _readable(folder, cameras) as readable:
        try:
            reconstruction = pycolmap.Reconstruction(str(readable))
        except (ValueError, LookupError, RuntimeError, MemoryError) as error:
            reason = str(error).strip().split("\n")[0]
            raise SceneError(f"{folder}: COLMAP cannot read the model ({reason}); export it again") from error
    return _model(reconstruction)


def write_colmap(
    folder: Path,
    images: Sequence[tuple[str, NDArray[np.float64], NDArray[np.float64]]],
    *,
    width: int,
    height: int,
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
    observations: Sequence[Observations],
) -> None:
    """Writes a binary COLMAP model with one EQUIRECTANGULAR camera.

    Each file appears atomically, points3D.bin last: where it is, the model is whole.

    Args:
        folder: where cameras.bin and the others go, such as SCENE/sparse/0; made if missing.
        images: (name, rotation (3, 3), translation (3,)), world-to-camera.
        width, height: pixels.
        points: (P, 3) world units.
        colors: (P, 3) RGB.
        observations: for each image the rows of the points that it sees and where, in pixels.
    """
    import pycolmap  # noqa: PLC0415

    camera = pycolmap.Camera(
        camera_id=1, model=EQUIRECTANGULAR, width=width, height=height, params=[float(width), float(height)]
    )
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for index, ((name, rotation, translation), (rows, pixels)) in enumerate(
        zip(images, observations, strict=True), start=1
    ):
        image = pycolmap.Image(
            name, np.asarray(pixels, np.float64).reshape(-1, 2), camera_id=1, image_id=index
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(rotation, np.float64)), translation)
        reconstruction.add_image_with_trivial_frame(image, pose)
        for feature, row in enumerate(rows):
            tracks[row].add_element(index, feature)
    for point, color, track in zip(points, colors, tracks, strict=True):
        reconstruction.add_point3D(point, track, color)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        reconstruction.write_binary(temporary)
        for file in sorted(Path(temporary).iterdir(), key=lambda file: file.name == "points3D.bin"):
            with atomic(folder / file.name) as whole:
                file.replace(whole)


def _check_panorama(folder: Path, camera: RawCamera) -> None:
    """Refuses what is no full 2:1 panorama."""
    W, H = camera.width, camera.height
    where = f"{folder}: camera {camera.id} ({camera.model}, {W} x {H})"
    if W != 2 * H or H < 1:
        raise SceneError(f"{where} is not 2:1; only full equirectangular panoramas can be used")
    if camera.model == PINHOLE and camera.params != (W, H, W / 2, H / 2):
        raise SceneError(f"{where} is a real pinhole camera; a panorama has the dummy W H W H W/2 H/2")
    if camera.model == EQUIRECTANGULAR and camera.params != (W, H):
        raise SceneError(f"{where} has parameters other than its width and height; export it again")
    if camera.model == SPHERE and camera.params[1:] != (W / 2, H / 2):
        raise SceneError(f"{where} does not have its centre in the middle of the image; export it again")


@contextmanager
def _readable(folder: Path, cameras: list[RawCamera]) -> Iterator[Path]:
    """`folder`, or with SPHERE cameras a copy by links whose cameras COLMAP knows.

    SphereSfM projects as COLMAP's EQUIRECTANGULAR does: longitude atan2(x, z), latitude down along y.
    """
    if all(camera.model != SPHERE for camera in cameras):
        yield folder
        return
    import pycolmap  # noqa: PLC0415

    suffix = model_suffix(folder)
    substitute = pycolmap.Reconstruction()
    for camera in cameras:
        size = {"width": camera.width, "height": camera.height}
        params = [float(camera.width), float(camera.height)]
        substitute.add_camera(
            pycolmap.Camera(camera_id=camera.id, model=EQUIRECTANGULAR, params=params, **size)
        )
    with tempfile.TemporaryDirectory() as name:
        temporary = Path(name)
        (substitute.write_binary if suffix == ".bin" else substitute.write_text)(name)
        for file in temporary.iterdir():
            if file.stem != "cameras":
                file.unlink()
        for stem in ("images", "points3D"):
            (temporary / f"{stem}{suffix}").symlink_to((folder / f"{stem}{suffix}").resolve())
        yield temporary


def _model(reconstruction: "pycolmap.Reconstruction") -> Model:
    """The registered images by name, and the points by id."""
    points3D = reconstruction.points3D
    ids = sorted(points3D)
    seen: dict[int, list[int]] = {}
    for row, key in enumerate(ids):
        for element in points3D[key].track.elements:
            seen.setdefault(element.image_id, []).append(row)
    images = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda i: str(i.name))
    poses = [image.cam_from_world() for image in images]
    return Model(
        names=tuple(str(image.name) for image in images),
        rotations=np.array([_rotation(pose.rotation.quat) for pose in poses]).reshape(-1, 3, 3),
        translations=np.array([pose.translation for pose in poses], np.float64).reshape(-1, 3),
        observed=tuple(np.unique(np.array(seen.get(i.image_id, []), np.int64)) for i in images),
        points=np.array([points3D[key].xyz for key in ids], np.float64).reshape(-1, 3),
        colors=np.array([points3D[key].color for key in ids], np.uint8).reshape(-1, 3),
    )


def _rotation(xyzw: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) of a quaternion that text has rounded: made unit first, so that the matrix is a rotation."""
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
