"""RUN/movers/: what Stage I takes for movers, as masks of their panoramas, and pictures of the worst ones."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.scene.errors import SceneError
from panolog.scene.files import write_bytes
from panolog.scene.image_files import decode_panorama
from panolog.scene.model import Panorama, Scene
from panolog.workers.metrics import sphere_weights

PICTURES = 6  # panoramas with the largest movers that are shown
_WIDTH, _QUALITY = 1024, 82  # pixels, at most, and JPEG quality of these
_TINT = np.array([230, 40, 200])  # RGB
_STRENGTH = 0.55


def write_movers(folder: RunFolder, scene: Scene) -> None:
    """Writes a mask for each training panorama with movers, the shares of all, and the pictures.

    Args: scene, with what Stage I has learnt. Raises OSError if a file cannot be written.
    """
    shares = {row: moving_share(scene.panoramas[row].movers) for row in scene.train}
    worst = sorted((row for row in scene.train if shares[row] > 0), key=lambda row: (-shares[row], row))
    folder.make(folder.movers)
    for row in worst:
        panorama = scene.panoramas[row]
        assert panorama.movers is not None
        mask = np.where(panorama.movers, 0, 255).astype(np.uint8)
        path = folder.mover_mask(panorama.name)
        folder.make(path.parent)
        write_bytes(path, bytes(cv2.imencode(".png", mask)[1]))
    pictured = list(_pictures(folder, [scene.panoramas[row] for row in worst[:PICTURES]]))
    named = [{"name": scene.panoramas[row].name, "share": share} for row, share in shares.items()]
    write_json(folder.mover_shares, {"panoramas": named, "pictures": pictured})


def moving_share(movers: NDArray[np.bool_] | None) -> float:
    """The part of the sphere that cells (h, w) of an equirectangular picture cover; 0 without any."""
    if movers is None:
        return 0.0
    area = sphere_weights(len(movers))
    return float((movers.mean(axis=1) * area).sum() / area.sum())


def _pictures(folder: RunFolder, panoramas: list[Panorama]) -> Iterator[str]:
    """Writes the photographs with their movers tinted; the names of those that can be read."""
    for panorama in panoramas:
        try:
            photograph = decode_panorama(panorama.image)
        except SceneError:  # it may have been damaged since: the run continues without it, and so does this
            continue
        path = folder.mover_picture(panorama.name)
        folder.make(path.parent)
        picture = cv2.cvtColor(_tinted(photograph, panorama), cv2.COLOR_RGB2BGR)
        write_bytes(path, bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]))
        yield panorama.name


def _tinted(photograph: NDArray[np.uint8], panorama: Panorama) -> NDArray[np.uint8]:
    width = min(_WIDTH, photograph.shape[1])
    size = (width, width // 2)
    picture = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    moving = np.asarray(panorama.movers, np.uint8)
    inside = cv2.resize(moving, size, interpolation=cv2.INTER_NEAREST) > 0
    picture[inside] += _STRENGTH * (_TINT - picture[inside])
    return np.rint(picture).astype(np.uint8)
