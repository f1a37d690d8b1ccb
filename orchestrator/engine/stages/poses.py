"""What a run writes of refined poses: a table of how far each camera moved, and a COLMAP model with them."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.scene.colmap import read_colmap, write_colmap
from panolog.scene.model import Panorama, Scene
from panolog.scene.read import model_folder
from panolog.workers.capture.captured import Captured
from panolog.workers.capture.poses import displacement

Array = NDArray[np.float64]


def save_poses(folder: RunFolder, captured: Captured | None, adjusted: Captured | None, scene: Scene) -> None:
    """Writes RUN/poses.json and RUN/sparse/0. Args: what Stage I and bundle adjustment know; scene, adjusted.

    Coordinates are those of the scene's COLMAP model. Raises OSError if the disk takes no file, SceneError if
    that model can no longer be read.
    """
    learnt = scene if captured is None else captured.applied(scene)
    bounded = _at_bound(captured) if captured is not None else {}
    given = {row: (scene.panoramas[row].rotation, scene.panoramas[row].translation) for row in bounded}
    if adjusted is not None:
        assert adjusted.given is not None
        poses = zip(adjusted.rows.tolist(), adjusted.given, strict=True)
        given |= {row: (pose[:, :3], pose[:, 3]) for row, pose in poses}
    offset, moves = np.array(scene.offset), []
    for row, (rotation, translation) in sorted(given.items()):
        after = learnt.panoramas[row]
        before = replace(after, rotation=rotation, translation=translation)
        moved = displacement(before, after, scene.points[before.observed])
        moves.append(
            {
                "name": before.name,
                "original": _pose(before, offset),
                "refined": _pose(after, offset),
                "moved": moved.shift,  # world units
                "turned": moved.turn,  # degrees
                "pixels": moved.angle * scene.width / (2 * np.pi),  # of the panorama, of what it sees; rms
                "at_bound": bounded.get(row, False),  # it would have moved on in Stage I
            }
        )
    write_json(folder.poses, {"panoramas": moves})
    _write_model(folder, learnt)


def _at_bound(captured: Captured) -> dict[int, bool]:
    rows = captured.rows.tolist()
    bounded = [False] * len(rows) if captured.at_bound is None else captured.at_bound.tolist()
    return dict(zip(rows, bounded, strict=True))


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
    folder.make(folder.sparse)
    write_colmap(
        folder.sparse,
        [(each.name, each.rotation, each.translation - each.rotation @ offset) for each in learnt.panoramas],
        width=learnt.width,
        height=learnt.height,
        points=learnt.points + offset,
        colors=learnt.colors,
        observations=[known.get(each.name, nothing) for each in learnt.panoramas],
    )
