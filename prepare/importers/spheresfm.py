"""SphereSfM's models: COLMAP's layout with SPHERE cameras. COLMAP's own EQUIRECTANGULAR ones are read alike.

World-to-camera; camera x right, y down, z forward (right-handed); longitude 0, the middle column, is +z: u =
W (atan2(x, z) / 2π + 1/2), v = H (asin(y / r) / π + 1/2), pixel centres at +0.5 as everywhere in COLMAP.
World units and axes are arbitrary. SPHERE has the parameters f, W/2, H/2, of which f means nothing, and the
number 11 that COLMAP gave to a fisheye. Source: SphereSfM's src/base/camera_models.h and COLMAP's
doc/format.rst.
"""

from collections.abc import Sequence
from pathlib import Path

from panolog.prepare.importers.interface import ImportedScene, ImportSource, find_panorama
from panolog.scene.colmap import ColmapImage, read_colmap
from panolog.scene.colmap_files import EQUIRECTANGULAR, SPHERE, read_cameras
from panolog.scene.errors import SceneError
from panolog.scene.read import MODELS
from panolog.scene.write import PosedImage

PANORAMA = (SPHERE, EQUIRECTANGULAR)


def find_model(folder: Path) -> Path | None:
    """Where in `folder` a COLMAP model is: itself or one of MODELS; None if nowhere."""
    for candidate in (folder, *(folder / name for name in MODELS)):
        if all(
            any((candidate / f"{stem}{end}").is_file() for end in (".bin", ".txt"))
            for stem in ("cameras", "images")
        ):
            return candidate
    return None


def require_model(folder: Path) -> Path:
    """The folder of the model, by `find_model`. Raises SceneError if it is nowhere."""
    found = find_model(folder)
    if found is None:
        raise SceneError(f"{folder}: there is no COLMAP model (cameras and images, .bin or .txt)")
    return found


def camera_models(folder: Path | None) -> set[str]:
    """The camera models of the COLMAP model in `folder`; empty without one, or if its cameras are damaged."""
    try:
        return {camera.model for camera in read_cameras(folder).values()} if folder is not None else set()
    except SceneError:
        return set()


def detect(source: ImportSource) -> bool:
    """Whether this is a folder with a model of panoramas, which nerfstudio has not converted."""
    folder = find_model(source.path)
    copied = folder == source.path / "colmap/sparse/0" and (source.path / "transforms.json").is_file()
    return not copied and bool(camera_models(folder) & set(PANORAMA))


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    folder = require_model(source.path)
    return from_model(folder, source.image_folders("images", "imgs"), source)


def from_model(folder: Path, folders: Sequence[Path], source: ImportSource) -> ImportedScene:
    """The scene of the model in `folder` with panoramas from `folders`; the user's PLY replaces its cloud."""
    model = read_colmap(folder)
    images = [_image(folder, image, folders) for image in model.images]
    return ImportedScene(images, model.points, model.colors).with_cloud(source)


def _image(where: Path, image: ColmapImage, folders: Sequence[Path]) -> PosedImage:
    camera = image.camera
    if camera.model not in PANORAMA:
        raise SceneError(f"{where}: {image.name[:60]} has a {camera.model} camera, which is not a panorama")
    found = find_panorama(f"{where}: images", folders, image.name)
    fractions = image.pixels / (camera.width, camera.height)
    return PosedImage(*found, image.rotation, image.translation, (image.points, fractions))
