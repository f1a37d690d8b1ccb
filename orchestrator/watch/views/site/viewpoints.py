"""Where a page in 3D may be looked at from: the cameras of a run's plan, and where to begin."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.folder import RunFolder, read_head
from panolog.partition.plan import Plan, read_plan
from panolog.scene.errors import InputError
from panolog.scene.files import Locate, here
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.stores.url import is_url
from panolog.workers.tasks import Stage, TaskId


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera, in world units."""

    position: NDArray[np.float64]  # (3,)
    ahead: NDArray[np.float64]  # (3,) unit


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """The viewpoints of a page."""

    up: NDArray[np.float64]  # (3,) unit
    start: Viewpoint
    cameras: dict[str, Viewpoint]  # by the name of the panorama, in the plan's order

    @property
    def positions(self) -> NDArray[np.float64]:
        """(C, 3) where the cameras are, in world units."""
        return np.stack([camera.position for camera in self.cameras.values()])


def read_viewpoints(
    folder: RunFolder, task: TaskId | None, camera: str | None = None, locate: Locate = here
) -> Viewpoints | None:
    """The viewpoints of a run's model or of a task's; None where no cameras are known, if none is named.

    Cameras are those that train the task, before there is a plan all, each towards the next; of a run that
    knows none, as one without blocks of an earlier version, those that train the scene. It begins at the
    panorama `camera`, else at the most central of them, towards the next, as one walks.

    Args: camera, the name of a panorama of the plan, or of the scene if `locate` is `here`; locate says where
    the run's files are to be read.
    Raises InputError if there is no such panorama, or the plan cannot be read.
    """
    if folder.known_plan.is_file():
        plan = read_plan(locate(folder.known_plan))
        names, centers = plan.names, plan.centers
        shown = [names[plan.rows.index(row)] for row in _rows(plan, task)]
    elif (scene := _scene_here(folder, locate)) is not None:
        names = tuple(scene.panoramas[row].name for row in scene.train)
        shown = list(names)
        centers = scene.centers[list(scene.train)]
    elif camera is None:
        return None
    else:
        raise InputError(f"{folder.root}: has no cameras yet, so no camera {camera}")
    up = _up(centers)
    ahead = _towards_next(centers, up)
    every = {name: Viewpoint(*pose) for name, *pose in zip(names, centers, ahead, strict=True)}
    start = every[shown[_central(np.stack([every[name].position for name in shown]))]]
    if camera is not None:
        start = every[camera] if camera in every else _of_scene(folder, camera, names, up, locate)
    return Viewpoints(up, start, {name: every[name] for name in shown})


def _scene_here(folder: RunFolder, locate: Locate) -> Scene | None:
    """The scene of a run, if it is on this machine."""
    path = read_head(folder)[0]
    if locate is not here or is_url(str(path)):
        return None
    with suppress(InputError):
        return read_scene(path)
    return None


def _rows(plan: Plan, task: TaskId | None) -> Sequence[int]:
    """The rows of the panoramas that train a task, all before it has any."""
    return (task and task.stage is Stage.BLOCK and plan.cameras(task.number)) or plan.rows


def _up(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) the axis perpendicular to the plane of the cameras (K, 3); y points down, as usual."""
    spread = np.ptp(centers, axis=0)
    axis = 1 if spread[1] == spread.min() else int(spread.argmin())
    up: NDArray[np.float64] = np.eye(3)[axis] * (-1 if axis == 1 else 1)
    return up


def _horizontal(directions: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) unit vectors of directions (..., 3) without their part along `up`; any if nothing is left."""
    flat = directions - (directions @ up)[..., None] * up
    flat = np.where(flat.any(axis=-1, keepdims=True), flat, np.roll(abs(up), 2))
    unit: NDArray[np.float64] = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
    return unit


def _towards_next(centers: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) unit directions from each of K centres to the next; the last one continues straight on."""
    beyond = 2 * centers[-1:] - centers[-2:][:1]
    return _horizontal(np.diff(centers, axis=0, append=beyond), up)


def _central(centers: NDArray[np.float64]) -> int:
    """The row of the most central of K centres (K, 3)."""
    return int(np.linalg.norm(centers - np.median(centers, axis=0), axis=1).argmin())


def _of_scene(
    folder: RunFolder, name: str, known: Sequence[str], up: NDArray[np.float64], locate: Locate
) -> Viewpoint:
    """A panorama that the plan does not have, such as a held-out one, towards the middle of its image."""
    panoramas = {}
    if locate is here:
        try:
            scene = read_scene(read_head(folder)[0])
        except InputError as error:
            raise InputError(f"camera {name}: is not in the run's plan, and its scene: {error}") from error
        panoramas = {panorama.name: panorama for panorama in scene.panoramas}
    if name not in panoramas:
        close = get_close_matches(name, panoramas or known, n=1) or known[:1]
        raise InputError(f"camera {name}: the run has no such panorama; one is {close[0]}")
    panorama = panoramas[name]
    return Viewpoint(panorama.center, _horizontal(panorama.rotation[2], up))
