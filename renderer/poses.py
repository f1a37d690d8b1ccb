"""Poses to render from: pose lists in three formats, and a smooth path through a scene's cameras.

`read_poses` recognises by content:

- JSON (`.json`): a list of `{"name": "a", "camera_to_world": [[4 numbers] x 3 or 4]}`, the name optional;
- COLMAP's `images.txt`: `id qw qx qy qz tx ty tz camera name`, world-to-camera, every other line its points;
- TUM trajectories: `time tx ty tz qx qy qz qw`, camera-to-world.

Camera axes are x right, y down, z forward in all three.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from panolog.scene.errors import InputError
from panolog.scene.model import Panorama

_NOT_UNIT = 1e-2  # how far a quaternion's length or a rotation's columns may be from 1
_TUM, _COLMAP = 8, 10  # fields of a line


@dataclass(frozen=True, eq=False)
class Pose:
    """Position and orientation of a view to render, world-to-camera."""

    name: str
    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,)


def read_poses(path: Path) -> list[Pose]:
    """The poses of a file, in its order. Raises InputError with the file and line or entry that is wrong."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InputError(f"{path}: cannot be read as a pose list: {reason}") from error
    poses = list(_from_json(path, text) if path.suffix.lower() == ".json" else _from_lines(path, text))
    if not poses:
        raise InputError(f"{path}: has no poses")
    return poses


def smooth_path(panoramas: Sequence[Panorama], frames: int) -> list[Pose]:
    """A path at constant speed through the positions of the panoramas, in their order, turning smoothly.

    Args: panoramas with at least two different positions; frames, how many poses, at least 2.
    Raises InputError with fewer than two positions or frames.

    >>> import panolog
    >>> poses = panolog.smooth_path(panolog.read_scene(SCENE).panoramas, frames=10)
    >>> len(poses), poses[0].name, poses[0].rotation.shape
    (10, 'frame_00000', (3, 3))
    """
    if frames < 2:
        raise InputError(f"a path needs at least two frames, not {frames}")
    centers = np.array([panorama.center for panorama in panoramas]).reshape(-1, 3)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    moved = np.concatenate([[True], steps > 1e-6 * steps.max(initial=0.0)])[: len(centers)]
    if moved.sum() < 2:
        raise InputError("a path needs panoramas at two different positions at least")
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centers[moved], axis=0), axis=1))])
    turns = Rotation.from_matrix(np.array([p.rotation.T for p in panoramas])[moved])
    at = np.linspace(0.0, distance[-1], frames)
    # monotone between positions: unlike a cubic spline it does not overshoot at corners
    positions = PchipInterpolator(distance, centers[moved])(at)
    return [
        _of_camera_to_world(f"frame_{i:05d}", turn, position)
        for i, (turn, position) in enumerate(zip(RotationSpline(distance, turns)(at), positions, strict=True))
    ]


def _of_camera_to_world(name: str, rotation: Rotation, position: NDArray[np.float64]) -> Pose:
    matrix = rotation.as_matrix().T
    return Pose(name, matrix, -matrix @ position)


def _from_json(path: Path, text: str) -> Iterator[Pose]:
    try:
        entries = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}: is not JSON: {error.msg}") from error
    if not isinstance(entries, list):
        raise InputError(f"{path}: must be a list of poses, each with camera_to_world")
    for number, entry in enumerate(entries):
        where = f"{path}: entry {number}"
        if not isinstance(entry, dict) or "camera_to_world" not in entry:
            raise InputError(f"{where}: has no camera_to_world")
        matrix = _matrix(where, entry["camera_to_world"])
        rotation = Rotation.from_matrix(matrix[:, :3])
        yield _of_camera_to_world(str(entry.get("name", f"pose_{number:05d}")), rotation, matrix[:, 3])


def _matrix(where: str, value: ArrayLike) -> NDArray[np.float64]:
    """(3, 4) of a 3x4 or 4x4 rigid camera-to-world matrix."""
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: camera_to_world must be 3 or 4 rows of 4 numbers") from error
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(f"{where}: camera_to_world must be 3 or 4 rows of 4 finite numbers")
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _NOT_UNIT or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: camera_to_world is not a rotation with a position; is it scaled or mirrored?"
        )
    return matrix[:3]


def _from_lines(path: Path, text: str) -> Iterator[Pose]:
    lines = [(n, line.split()) for n, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]
    first = next((fields for _, fields in lines if fields), [])
    if len(first) >= _COLMAP:
        while lines and not lines[0][1]:
            lines.pop(0)
        yield from (_colmap_pose(f"{path}:{n}", fields) for n, fields in lines[::2] if fields)
    else:
        yield from (_tum_pose(f"{path}:{n}", fields) for n, fields in lines if fields)


def _colmap_pose(where: str, fields: list[str]) -> Pose:
    if len(fields) < _COLMAP:
        raise InputError(f"{where}: an image needs 'id qw qx qy qz tx ty tz camera name'")
    w, x, y, z, *translation = _numbers(where, fields[1:8])
    rotation = _rotation(where, [x, y, z, w])
    return Pose(" ".join(fields[9:]), rotation.as_matrix(), np.array(translation))


def _tum_pose(where: str, fields: list[str]) -> Pose:
    if len(fields) != _TUM:
        raise InputError(
            f"{where}: a pose needs 'time tx ty tz qx qy qz qw', this line has {len(fields)} fields"
        )
    numbers = _numbers(where, fields)
    return _of_camera_to_world(fields[0], _rotation(where, numbers[4:]), np.array(numbers[1:4]))


def _numbers(where: str, fields: list[str]) -> list[float]:
    try:
        numbers = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: a pose must be numbers, not {' '.join(fields)[:60]}") from error
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{where}: a pose must be finite numbers")
    return numbers


def _rotation(where: str, quaternion: list[float]) -> Rotation:
    """The rotation of a unit quaternion x y z w."""
    length = math.hypot(*quaternion)
    if abs(length - 1) > _NOT_UNIT:
        raise InputError(f"{where}: the quaternion has the length {length:.4g}, must be 1")
    return Rotation.from_quat(quaternion)
