"""The keyframes JSON of OmniGS: cameras.json, written next to a model with input.ply or point_cloud.ply.

A list of `{"id", "img_name", "width", "height", "position": [3], "rotation": [3][3], ...}`: rotation (rows)
and position are camera-to-world; camera x right, y down, z forward, longitude 0 at +z. Source:
keyframesToJson in OmniGS' src/gaussian_mapper.cpp, which inverts the world-to-camera pose that it renders
with. Its rasterizer takes a pixel's centre at +0.5. What OmniGS reads (poses.json, colorized.ply) is
openMVG's; see `openmvg`.

The cloud is input.ply, which OmniGS writes as plain points. Without it, points are triangulated.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from panolog.prepare.importers.interface import (
    ImportedScene,
    ImportSource,
    find_panorama,
    pose_from_camera_to_world,
)
from panolog.prepare.importers.json_xml import JsonNode, load_json
from panolog.scene.write import PosedImage

FILES = ("cameras.json", "keyframes.json")


def detect(source: ImportSource) -> bool:
    """Whether this is a list of keyframes or a folder with one."""
    head = source.json_head(*FILES)
    return head.startswith(b"[") and b'"img_name"' in head and b'"position"' in head


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    folders = source.image_folders("images")
    images = [_image(entry, folders) for entry in load_json(source.json_file(*FILES), source.memory)]
    return ImportedScene(images, *source.cloud("input.ply"))


def _image(entry: JsonNode, folders: Sequence[Path]) -> PosedImage:
    matrix = np.column_stack([entry["rotation"].array(3, 3), entry["position"].array(3)])
    rotation, translation = pose_from_camera_to_world(entry["rotation"].where, matrix, np.eye(3))
    name = entry["img_name"]
    return PosedImage(*find_panorama(name.where, folders, name.text()), rotation, translation)
