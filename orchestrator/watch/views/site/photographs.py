"""Photographs of a scene for pages: small copies, and how each panorama is turned."""

import os
import struct
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from PIL import Image

from panolog.orchestrator.runs.folder import is_below
from panolog.scene.colmap_files import read_image_records
from panolog.scene.errors import InputError
from panolog.scene.files import file_of
from panolog.scene.pictures.profiles import in_srgb
from panolog.scene.read import check_names, image_folder, model_folder
from panolog.scene.stores.store import PATIENCE_S
from panolog.scene.stores.stored_scenes import whole

WIDE = 2048  # pixels of a copy in 3D
STORE_S = 10.0  # for which a store may fail before a page shows no picture
_BYTES = 300_000_000  # of a panorama's file at most
_PIXELS = 2**27  # of a panorama at most: 16,384 x 8,192
Part = Literal["whole", "render", "truth"]
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF")
# What a damaged image makes Pillow raise.
_DAMAGED = (OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError)


def small_copy(file: BinaryIO, name: str, width: int, part: Part = "whole") -> bytes:
    """A JPEG of at most `width` pixels, half as high, without metadata such as where it was taken.

    Args: part, of a square picture that has a render above its photograph.
    Raises InputError if the file is too large, no image, or no such picture.
    """
    require_size(file.seek(0, os.SEEK_END), name)
    file.seek(0)
    try:
        with Image.open(file, formats=_FORMATS if part == "whole" else ["JPEG"]) as picture:  # the header
            if picture.width * picture.height > _PIXELS:
                raise InputError(f"{name} has more than {_PIXELS:,} pixels")
            if part != "whole" and picture.width > picture.height:
                raise InputError(f"{name} is no render above a photograph")
            picture.draft("RGB", (width, width // 2))  # JPEG can be decoded smaller
            picture.thumbnail((width, width // 2 if part == "whole" else 2 * width), reducing_gap=3.0)
            half, end = picture.width // 2, picture.height
            top, end = {"whole": (0, end), "render": (0, half), "truth": (end - half, end)}[part]
            output = BytesIO()
            in_srgb(picture.crop((0, top, picture.width, end))).save(output, "JPEG", quality=85)
    except _DAMAGED as error:
        raise InputError(f"{name} cannot be decoded") from error
    return output.getvalue()


def require_size(size: int, name: str) -> None:
    """Raises InputError if a panorama's file is too large to be looked at. Args: size, bytes."""
    if size > _BYTES:
        raise InputError(f"{name} has more than {_BYTES:,} bytes")


def photograph(scene: Path, name: str, patience: float = PATIENCE_S) -> bytes:
    """A small copy of a panorama of a scene. Args: patience, seconds for which its store may fail.

    Raises InputError if there is no such scene, or no image of that name really below it; StoreLostError.
    """
    check_names(scene, [name])
    path = file_of(image_folder(scene), name).resolve()
    if not is_below(path, scene):
        raise InputError(f"{name} is missing in {image_folder(scene)}, or a link that leads out of the scene")
    require_size(path.stat().st_size, name)
    data = whole(path, patience)  # of a scene in an object store
    with path.open("rb") if data is None else BytesIO(data) as file:
        return small_copy(file, name, WIDE)


def panorama_rotations(scene: Path, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """(3, 3) from the world to each panorama's axes, of those of `names` that the scene has.

    Raises InputError if there is no such scene on this machine, or its model is damaged.
    """
    if not (scene.is_absolute() and scene.is_dir()):
        raise InputError(f"the scene {scene} is not on this machine")
    wanted, found = set(names), {}
    try:
        for record in read_image_records(model_folder(scene), observations=False):
            quaternion = np.array(record.pose[:4])
            if record.name in wanted and np.isfinite(quaternion).all() and quaternion.any():
                found[record.name] = scipy.spatial.transform.Rotation.from_quat(
                    quaternion, scalar_first=True
                ).as_matrix()
    except OSError as error:
        raise InputError(f"{error.filename or scene}: cannot be read ({error.strerror})") from error
    return found
