"""EgoNeRF's layout of Ricoh360: imgs/, output_dir/colmap/*.txt, train.txt and test.txt with stems.

The model is SphereSfM's in text form, camera number 0: world-to-camera, camera x right, y down, z forward,
longitude 0 at +z, pixel centres at +0.5; units are arbitrary. It may name .jpg where the images are .png, and
its size may be that of the original images, so pixels are taken as fractions. EgoNeRF itself turns the world
so that its former -y is up, and scales it: neither is done here. Source: EgoNeRF's
dataLoader/pose_descriptor.py, dataset_egocentric_video.py, ray_utils.py.

imgs/mask.png is no panorama, and what its values mean is not published: it is left out.
"""

from panolog.prepare.importers.interface import ImportedScene, ImportSource, image_folders, read_stems
from panolog.prepare.importers.raw_colmap import model_folder
from panolog.prepare.importers.spheresfm import from_model
from panolog.scene.errors import InputError

_MODELS = ("output_dir/colmap", "colmap")


def detect(source: ImportSource) -> bool:
    """Whether this is a folder in this layout."""
    return any(model_folder(source.path / name) == source.path / name for name in _MODELS)


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene.

    Raises:
        InputError: what is wrong with it, with file and field.
        OSError: a file cannot be read.
    """
    folder = next((source.path / name for name in _MODELS if model_folder(source.path / name)), None)
    if folder is None:
        raise InputError(f"{source.path}: there is no COLMAP model in {_MODELS[0]}")
    parsed = from_model(folder, image_folders(source, "imgs", "images"), source.points)
    train, test = (read_stems(source.path / f"{part}.txt") for part in ("train", "test"))
    return ImportedScene(parsed.images, parsed.points, parsed.colors, train, test)
