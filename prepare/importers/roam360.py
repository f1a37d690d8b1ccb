"""The 360Roam data set, as published and as ODGS prepared it (with other data sets in the same layout).

- As published: images/, pose_c2w.json with `train` and `test`, lists of {"rgb_file", "transform_matrix"}, and
  scene.ply (or <folder>.ply). Matrices are camera-to-world (4, 4); camera x right, y down, z forward,
  longitude 0 at +z; the units are about metres; where a pixel has its centre is not published, +0.5 is
  assumed. Source: OmniGS' scripts/360roam_to_openmvg_train.py, which inverts the matrices into openMVG's
  poses without changing axes.
- As ODGS prepared it: images/, data_views.json and data_extrinsics.json (the two halves of an openMVG
  sfm_data, see `openmvg` for the convention), pcd.ply, train.txt and test.txt with stems. Source: ODGS' data
  loader.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from panolog.prepare.importers import openmvg
from panolog.prepare.importers.interface import ImportedScene, ImportSource, posed_image
from panolog.prepare.importers.json_xml import load_json
from panolog.scene.errors import SceneError
from panolog.scene.files import stem_of
from panolog.scene.write import PosedImage


def detect(source: ImportSource) -> bool:
    """Whether this is a folder in one of the two layouts, or its pose_c2w.json."""
    return source.first("pose_c2w.json") is not None or _is_prepared(source.path)


def read(source: ImportSource) -> ImportedScene:
    """Reads the scene; see `interface`."""
    folders = source.image_folders("images")
    if _is_prepared(source.path):
        return _prepared(source, folders)
    path = source.first("pose_c2w.json")
    if path is None:
        raise SceneError(
            f"{source.path}: has neither pose_c2w.json nor data_views.json and data_extrinsics.json"
        )
    content = load_json(path, source.memory)
    split: dict[str, list[PosedImage]] = {}
    for part in ("train", "test"):
        entries = content.get(part)
        split[part] = [
            posed_image(entry["transform_matrix"], entry["rgb_file"], folders, np.eye(3))
            for entry in (entries if entries is not None else ())
        ]
    train, test = ([stem_of(image.name) for image in part] for part in split.values())
    cloud = source.cloud("scene.ply", _named_cloud(source))
    return ImportedScene([*split["train"], *split["test"]], *cloud, train, test)


def _is_prepared(folder: Path) -> bool:
    return all((folder / name).is_file() for name in ("data_views.json", "data_extrinsics.json"))


def _prepared(source: ImportSource, folders: Sequence[Path]) -> ImportedScene:
    root = source.path
    views, extrinsics = (
        load_json(root / f"data_{part}.json", source.memory) for part in ("views", "extrinsics")
    )
    cloud = source.cloud("pcd.ply", _named_cloud(source))
    return openmvg.assemble(views["views"], extrinsics["extrinsics"], folders, cloud)


def _named_cloud(source: ImportSource) -> str:
    """The name that a cloud may have: that of its folder."""
    return f"{source.folder.resolve().name}.ply"
