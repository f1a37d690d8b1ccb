"""What is known of a place before anything is trained, shown as Stage I shows itself."""

import numpy as np
import torch

from panolog.partition.cells import Volume
from panolog.renderer.camera import Camera
from panolog.renderer.render import render
from panolog.scene.files import Locate
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.model import Scene
from panolog.workers.events import Checkpoint, Preview
from panolog.workers.showing.previews import MOST, PREVIEW_WIDTH, picture, snapshot
from panolog.workers.tasks import COARSE
from panolog.workers.training.initialise import scene_gaussians

_OPACITY = 0.9  # the points are to be seen, not to be trained


def shown_row(scene: Scene, part: Volume | None = None) -> int | None:
    """The row of the panorama that pictures of a training show: the most central one that is held out.

    None if there is none in the part of the place, or its file is gone. Args: part, None = all of the place.
    """
    rows = np.array(scene.test, np.int64)
    rows = rows if part is None else rows[part.contains(scene.centers[rows])]
    if not len(rows):
        return None
    centers = scene.centers[rows]
    row = int(rows[np.linalg.norm(centers - np.median(centers, axis=0), axis=1).argmin()])
    return row if scene.panoramas[row].image.is_file() else None


def first_look(scene: Scene, locate: Locate) -> Preview:
    """The points of a scene from a panorama, above its photograph, and as a model for the 3D view.

    The preview of iteration 0 of Stage I, in which one sees whether poses and points fit, minutes before
    training shows it. Args: locate, where files of the scene are.
    Raises SceneError or OSError if the panorama cannot be read.
    """
    shown = shown_row(scene)
    row = scene.train[0] if shown is None else shown
    panorama, width = scene.panoramas[row], min(scene.width, PREVIEW_WIDTH)
    photograph, _ = decode_with_alpha(locate(panorama.image), width)
    some = np.arange(0, len(scene.points), -(-len(scene.points) // MOST))
    model = scene_gaussians(scene, some, opacity=_OPACITY)
    with torch.no_grad():
        jpeg = picture(render(model, Camera.at(panorama, width), sh_degree=0).color, photograph)
    middle = scene.centers[list(scene.train)].mean(axis=0)
    saved = Checkpoint(COARSE, 0, snapshot(model, middle))
    return Preview(COARSE, 0, panorama.name, jpeg, row == shown, saved)
