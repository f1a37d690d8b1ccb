"""EgoNeRF's layouts of two data sets, Ricoh360 and OmniBlender; both have train.txt and test.txt with stems.

Ricoh360: imgs/ and output_dir/colmap/*.txt. The model is SphereSfM's in text form, camera number 0:
world-to-camera, camera x right, y down, z forward, longitude 0 at +z, pixel centres at +0.5; units are
arbitrary. It may name .jpg where the images are .png, and its size may be that of the original images, so
pixels are taken as fractions. EgoNeRF itself rotates the world so that its former -y is up, and scales it:
neither is done here. imgs/mask.png, whose values are not explained anywhere, is left out.
Source: EgoNeRF's dataLoader/pose_descriptor.py, dataset_egocentric_video.py, ray_utils.py.

OmniBlender: images/ and transform.json. `transform_matrix` is camera-to-world; camera x right, y up, z
backward (Blender's; right-handed), so longitude 0, the middle column, is -z; pixel centres are at +0.5. The
world is Blender's, z up, in metres. The data set has no points: they are triangulated, unless a cloud of the
same world is given or is next to it (ODGS' preparation of the data has one: see `roam360`). Source: EgoNeRF's
dataLoader/dataset_omniblender.py and get_ray_directions_360 in ray_utils.py.
"""

from panolog.prepare.importers.interface import FLIP_YZ, ImportedScene, ImportSource, posed_image, read_head
from panolog.prepare.importers.json_xml import load_json
from panolog.prepare.importers.spheresfm import find_model, from_model
from panolog.scene.errors import SceneError

_MODELS = ("output_dir/colmap", "colmap")
_TRANSFORMS = "transform.json"


def detect_ricoh360(source: ImportSource) -> bool:
    """Whether this is a folder in the layout of Ricoh360."""
    return any(find_model(source.path / name) == source.path / name for name in _MODELS)


def read_ricoh360(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    folder = next((source.path / name for name in _MODELS if find_model(source.path / name)), None)
    if folder is None:
        raise SceneError(f"{source.path}: there is no COLMAP model in {_MODELS[0]}")
    return from_model(folder, source.image_folders("imgs", "images"), source)


def detect_omniblender(source: ImportSource) -> bool:
    """Whether this is a transform.json or a folder with one."""
    path = source.first(_TRANSFORMS)
    return path is not None and b'"frames"' in read_head(path)


def read_omniblender(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    folders = source.image_folders("images")
    frames = load_json(source.json_file(_TRANSFORMS), source.memory)["frames"]
    images = [posed_image(it["transform_matrix"], it["file_path"], folders, FLIP_YZ) for it in frames]
    return ImportedScene(images, *source.cloud("pcd.ply", "points.ply"))
