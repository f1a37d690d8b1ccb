"""The files around a COLMAP model, named as the paper's authors publish Pano360; all but the images optional.

SCENE/images/ or imgs/          panoramas, sub-folders allowed
SCENE/sparse/0/                 the COLMAP model, here or in SCENE/sparse
SCENE/sparse/0/points3D.ply     the cloud, where the model itself has no points
SCENE/sparse/0/depth_params.json    {stem: {"scale": s, "offset": o}} of eq. 4
SCENE/depths/STEM.png           16-bit inverse radial depth, 0 = sky
SCENE/skymasks/STEM.png         8 bit, 255 foreground, 0 sky
SCENE/masks/STEM.png            8 bit, 0 = ignore
SCENE/train.txt, test.txt       stems
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import SceneError
from panolog.scene.ply_table import read_table

DEPTHS, SKY_MASKS, MASKS = "depths", "skymasks", "masks"


def model_folder(root: Path) -> Path:
    """Where the COLMAP model of a scene is.

    Raises:
        SceneError: there is no scene or no model.
    """
    if not root.is_dir():
        raise SceneError(f"{root}: there is no such folder; give a folder with images and a COLMAP model")
    candidates = (root / "sparse" / "0", root / "sparse")
    for folder in candidates:
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    raise SceneError(f"{root}: there is no COLMAP model in sparse/0; reconstruct the scene first")


def image_folder(root: Path) -> Path:
    """Where the panoramas of a scene are. Raises SceneError if there is no such folder."""
    for name in ("images", "imgs"):
        if (root / name).is_dir():
            return root / name
    raise SceneError(f"{root}: there is no folder images or imgs; put the panoramas there")


def find_layer(root: Path, layer: str, names: tuple[str, ...]) -> list[Path | None]:
    """The file of each panorama in the folder `layer`: STEM.png, or NAME.png as COLMAP names masks.

    Raises:
        SceneError: the folder is there, but no panorama has a file in it.
    """
    folder = root / layer
    if not folder.is_dir():
        return [None] * len(names)
    found = [_first(folder / Path(name).with_suffix(".png"), folder / f"{name}.png") for name in names]
    if not any(found):
        wanted = Path(names[0]).with_suffix(".png")
        raise SceneError(f"{folder}: no file here belongs to a panorama ({wanted} would); rename them")
    return found


def read_depth_params(folder: Path) -> dict[str, tuple[float, float]]:
    """(scale, offset) of eq. 4 by stem, from depth_params.json beside the model; empty without the file.

    They are as the file has them: where a fit failed, tools write a scale of 0 or NaN.

    Raises:
        SceneError: the file is no JSON of that form.
    """
    path = folder / "depth_params.json"
    if not path.is_file():
        return {}
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {stem: (float(entry["scale"]), float(entry["offset"])) for stem, entry in entries.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneError(f'{path}: not {{"stem": {{"scale": s, "offset": o}}, ...}} ({error!r})') from error


def read_cloud(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points (P, 3) in world units and colours (P, 3) of a binary PLY with x y z red green blue.

    Raises:
        PlyError: not a binary PLY, or truncated.
        SceneError: it lacks one of these columns.
    """
    table = read_table(path)
    columns = ("x", "y", "z", "red", "green", "blue")
    if missing := [name for name in columns if name not in (table.dtype.names or ())]:
        raise SceneError(f"{path}: the point cloud has no column {missing[0]}")
    if any(table.dtype[name] != np.uint8 for name in columns[3:]):
        raise SceneError(f"{path}: the colours of the point cloud are not 8 bit; save them as uchar")
    rows = table.rows(0, table.count)
    points = np.stack([rows[name].astype(np.float64) for name in columns[:3]], axis=1)
    return points, np.stack([rows[name] for name in columns[3:]], axis=1)


def _first(*paths: Path) -> Path | None:
    return next((path for path in paths if path.is_file()), None)
