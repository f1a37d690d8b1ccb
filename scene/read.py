"""Reads a scene folder: the one way into the system, so all input is checked here."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from panolog.scene.check import check_geometry, check_images, check_layer, check_names, check_training
from panolog.scene.colmap import PanoramaModel, read_panoramas
from panolog.scene.errors import SceneError
from panolog.scene.files import StrPath
from panolog.scene.model import Panorama, Scene
from panolog.scene.pano360 import (
    DEPTHS,
    MASKS,
    SKY_MASKS,
    find_layer,
    image_folder,
    model_folder,
    read_cloud,
    read_depth_params,
)
from panolog.scene.split import read_split


def read_scene(path: StrPath) -> Scene:
    """Reads and checks a scene: a COLMAP model, its panoramas and the optional folders of `scene.pano360`.

    Every image file is opened and found complete, but none is decoded.

    Args:
        path: the scene's folder.

    Raises:
        SceneError: what is wrong with it, in one line.
        PlyError: its points3D.ply is damaged.
    """
    root = Path(path).resolve()
    try:
        return _read(root)
    except OSError as error:  # a file or folder that may not be read, or is gone meanwhile
        raise SceneError(f"{error.filename or root}: cannot be read ({error.strerror})") from error


def _read(root: Path) -> Scene:
    folder = model_folder(root)
    model = _with_cloud(folder, read_panoramas(folder))
    check_geometry(folder, model)
    check_names(folder, model.names)
    panoramas = _panoramas(root, folder, model)
    width, height = check_images([panorama.image for panorama in panoramas])
    check_layer([panorama.mask for panorama in panoramas], bits=8)
    check_layer([panorama.sky_mask for panorama in panoramas], bits=8)
    check_layer([panorama.depth for panorama in panoramas], bits=16)
    train, test = read_split(root, [panorama.stem for panorama in panoramas])
    fingerprint = _fingerprint(panoramas, model, train, test)
    scene = Scene(root, width, height, panoramas, model.points, model.colors, train, test, fingerprint)
    check_training(root, scene.centers[list(train)])
    return scene


def _with_cloud(folder: Path, model: PanoramaModel) -> PanoramaModel:
    """The model with the points of points3D.ply, if it has none of its own."""
    cloud = folder / "points3D.ply"
    if len(model.points) or not cloud.is_file():
        return model
    points, colors = read_cloud(cloud)
    return replace(model, points=points, colors=colors)


def _panoramas(root: Path, folder: Path, model: PanoramaModel) -> tuple[Panorama, ...]:
    images = image_folder(root)
    layers = (find_layer(root, layer, model.names) for layer in (MASKS, SKY_MASKS, DEPTHS))
    affines = read_depth_params(folder)
    return tuple(
        Panorama(
            name=name,
            image=images / name,
            rotation=model.rotations[row],
            translation=model.translations[row],
            observed=model.observed[row],
            mask=mask,
            sky_mask=sky_mask,
            depth=depth,
            depth_affine=affines.get(str(Path(name).with_suffix(""))),
        )
        for row, (name, mask, sky_mask, depth) in enumerate(zip(model.names, *layers, strict=True))
    )


def _fingerprint(
    panoramas: tuple[Panorama, ...], model: PanoramaModel, train: tuple[int, ...], test: tuple[int, ...]
) -> str:
    """sha256 of all that training depends on; of files only their names and sizes, so it takes no time."""
    described = [
        [
            panorama.name,
            panorama.depth_affine,
            *(
                file.stat().st_size if file else None
                for file in (panorama.image, panorama.mask, panorama.sky_mask, panorama.depth)
            ),
        ]
        for panorama in panoramas
    ]
    digest = hashlib.sha256(json.dumps([described, train, test]).encode())
    arrays: list[NDArray[Any]] = [
        model.rotations,
        model.translations,
        model.points,
        model.colors,
        *model.observed,
    ]
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()
