"""What a run writes of refined poses: a table of how far each camera moved, and a COLMAP model with them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.scene.colmap import read_colmap, write_colmap
from panolog.scene.model import Panorama, Scene
from panolog.scene.read import model_folder
from panolog.workers.capture.captured import Captured
from panolog.workers.capture.poses import displacement

Array = NDArray[np.float64]


def save_poses(folder: RunFolder, captured: Captured, scene: Scene) -> None:
    """Writes RUN/poses.json and RUN/sparse/0. Args: scene, with the poses before.

    Coordinates are those of the scene's COLMAP model. Raises OSError if the disk takes no file, SceneError if
    that model can no longer be read.
    """
    learnt = captured.applied(scene)
    write_json(folder.poses, {"panoramas": _moves(captured, scene, learnt)})
    _write_model(folder, learnt)


def _moves(captured: Captured, scene: Scene, learnt: Scene) -> list[dict[str, Any]]:
    """How far each training camera moved, by name."""
    offset, found = np.array(scene.offset), []
    bounded = np.zeros(len(captured.rows), bool) if captured.at_bound is None else captured.at_bound
    for row, at_bound in zip(captured.rows.tolist(), bounded.tolist(), strict=True):
        before, after = scene.panoramas[row], learnt.panoramas[row]
        moved = displacement(before, after, scene.points[before.observed])
        found.append(
            {
                "name": before.name,
                "original": _pose(before, offset),
                "refined": _pose(after, offset),
                "moved": moved.shift,  # world units
                "turned": moved.turn,  # degrees
                "pixels": moved.angle * scene.width / (2 * np.pi),  # of the panorama, of what it sees; rms
                "at_bound": at_bound,  # it would have moved on
            }
        )
    return found


def _pose(panorama: Panorama, offset: Array) -> dict[str, Any]:
    """World-to-camera, as in COLMAP."""
    translation = panorama.translation - panorama.rotation @ offset
    return {"rotation": panorama.rotation.tolist(), "translation": translation.tolist()}


def _write_model(folder: RunFolder, learnt: Scene) -> None:
    """The scene's points, what each panorama has seen of them, and its pose."""
    tracked = any(len(panorama.observed) for panorama in learnt.panoramas)
    images = read_colmap(model_folder(learnt.root)).images if tracked else []
    known = {
        image.name: (image.points, image.pixels * (learnt.width / image.camera.width)) for image in images
    }
    nothing = (np.zeros(0, np.int64), np.zeros((0, 2)))
    offset = np.array(learnt.offset)
    write_colmap(
        folder.sparse,
        [(each.name, each.rotation, each.translation - each.rotation @ offset) for each in learnt.panoramas],
        width=learnt.width,
        height=learnt.height,
        points=learnt.points + offset,
        colors=learnt.colors,
        observations=[known.get(each.name, nothing) for each in learnt.panoramas],
    )
