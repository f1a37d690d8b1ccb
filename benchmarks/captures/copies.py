"""A copy of a scene with other pictures."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.model import Scene
from panolog.scene.write import require_new

Change = Callable[[str, NDArray[np.uint8]], NDArray[np.uint8]]  # name and picture (H, W, 3) BGR


def copy_scene(scene: Scene, output: Path, change: Change) -> None:
    """Writes the scene to a new folder, with all pictures changed and kept without loss.

    Raises OSError if the disk takes no file, InputError if `output` exists or a picture is not PNG.
    """
    require_new(output)
    images = next(name for name in ("images", "imgs") if (scene.root / name).is_dir())
    shutil.copytree(scene.root, output, ignore=shutil.ignore_patterns(images, "depth_truth.json"))
    for panorama in scene.panoramas:
        path = output / images / panorama.name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = cv2.imread(str(panorama.image), cv2.IMREAD_COLOR)
        assert picture is not None
        if path.suffix.lower() == ".png":
            cv2.imwrite(str(path), change(panorama.name, np.asarray(picture, np.uint8)))
        else:
            quality = [cv2.IMWRITE_JPEG_QUALITY, 98]
            cv2.imwrite(str(path), change(panorama.name, np.asarray(picture, np.uint8)), quality)
