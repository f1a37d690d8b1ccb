"""EgoNeRF's layout of OmniBlender: images/, transform.json, train.txt and test.txt with stems.

`transform_matrix` is camera-to-world; camera x right, y up, z backward (Blender's; right-handed), so
longitude 0, the middle column, is -z; pixel centres are at +0.5. The world is Blender's, z up, in metres.
Source: EgoNeRF's dataLoader/dataset_omniblender.py and get_ray_directions_360 in ray_utils.py.

The data set has poses only, as it is rendered: its points are triangulated, unless a cloud of the same world
is given or lies beside it. (ODGS' preparation of the data has a cloud: see `roam360`.)
"""

from collections.abc import Sequence
from pathlib import Path

from panolog.prepare.importers.interface import (
    ImportedScene,
    ImportSource,
    find_panorama,
    image_folders,
    read_stems,
)
from panolog.prepare.importers.json_xml import Node, load_json
from panolog.prepare.importers.point_cloud import read_optional_cloud
from panolog.prepare.importers.poses import FLIP_YZ, pose_from_camera_to_world
from panolog.scene.new_scene import PosedImage

FILES = ("transform.json",)
_CLOUDS = ("pcd.ply", "points.ply")


def detect(source: ImportSource) -> bool:
    """Whether this is a transform.json or a folder with one."""
    path = source.first(*FILES)
    if path is None:
        return False
    with path.open("rb") as file:
        return b'"frames"' in file.read(65536)


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene.

    Raises:
        InputError: what is wrong with it, with file and field.
        OSError: a file cannot be read.
    """
    path = source.first(*FILES) or source.path
    folders = image_folders(source, "images")
    images = [_image(frame, folders) for frame in load_json(path)["frames"]]
    cloud = source.points or next(filter(Path.is_file, (source.folder / name for name in _CLOUDS)), None)
    points, colors = read_optional_cloud(cloud)
    train, test = (read_stems(source.folder / f"{part}.txt") for part in ("train", "test"))
    return ImportedScene(images, points, colors, train, test)


def _image(frame: Node, folders: Sequence[Path]) -> PosedImage:
    matrix, name = frame["transform_matrix"], frame["file_path"]
    pose = pose_from_camera_to_world(matrix.where, matrix.array(4, 4), FLIP_YZ)
    return PosedImage(*find_panorama(name.where, folders, name.text()), *pose)
