"""The sky of a model as a picture: what engines use as a skybox, and what lights a scene."""

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from panolog.export.frame import Frame
from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.errors import InputError, require
from panolog.scene.files import atomic, write_bytes
from panolog.scene.gaussians import Gaussians

WIDTH = 2048  # pixels
SUFFIXES = (".jpg", ".jpeg", ".exr")
_QUALITY = 90  # of JPEG
_SEEN = 1 / 255  # opacity below which a pixel shows nothing

Image = NDArray[np.float32]


def render_sky(sky: Gaussians, frame: Frame, width: int = WIDTH) -> Image:
    """(W / 2, W, 3) the sky around the origin of an exported frame: equirectangular, its middle towards −z.

    Where the sky has no Gaussians, most often below the horizon, its colours are continued.

    Args: sky, at least one Gaussian, in the model's coordinates.
    """
    forward = np.diag([1.0, -1.0, -1.0]) @ frame.rotation  # cameras look along z, with y down
    rotation = torch.from_numpy(forward.astype(np.float32))
    translation = torch.from_numpy((-forward @ frame.origin).astype(np.float32))
    with torch.no_grad():
        seen = render(sky, Camera(rotation, translation, width, width // 2))
    return _continued(seen.color.numpy(), seen.alpha.numpy())


def write_sky_image(path: Path, image: Image) -> None:
    """Writes (H, W, 3) colours of `render_sky`, atomically: as JPEG, or as EXR with linear light in float16.

    Raises InputError for another suffix, or if OpenEXR is not installed; OSError if it cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        _write_exr(path, image)
    elif suffix in SUFFIXES:
        pixels = np.rint(image.clip(0, 1) * 255).astype(np.uint8)[:, :, ::-1]
        encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        write_bytes(path, encoded.tobytes())
    else:
        raise InputError(f"{path}: the picture of a sky is .jpg or .exr")


def _continued(color: Image, alpha: Image) -> Image:
    """The colours without their background, and where nothing is seen those of larger and larger places."""
    levels = [np.where((alpha > _SEEN)[:, :, None], np.dstack([color, alpha]), 0)]  # (H, W, 4) RGB and alpha
    while levels[-1].shape[0] > 1:
        height, width = levels[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA), np.float32))
    found = levels[-1][:, :, :3] / max(float(levels[-1][:, :, 3].mean()), _SEEN)
    for level in levels[-2::-1]:
        below = cv2.resize(found, level.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        found = level[:, :, :3] + below.reshape(*level.shape[:2], 3) * (1 - level[:, :, 3:])
    return np.asarray(found, np.float32)


def _write_exr(path: Path, image: Image) -> None:
    require("OpenEXR")
    import OpenEXR  # noqa: PLC0415  # needed for this alone

    dark = image.clip(0, None)
    linear = np.where(dark <= 0.04045, dark / 12.92, ((dark + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic(path) as temporary:
        try:
            OpenEXR.File(header, {"RGB": linear.astype(np.float16)}).write(str(temporary))
        except RuntimeError as error:  # so it says that the disk is full
            raise OSError(f"{path}: {error}") from error
