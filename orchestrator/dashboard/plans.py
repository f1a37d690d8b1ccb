"""The plan of a run for its map. The scores of a thousand blocks are read as numbers, not as text."""

import json
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.dashboard.places import Place, by_handle, opened, read_below
from panolog.orchestrator.figures import map_figure
from panolog.orchestrator.map_raster import read_points, standings_of
from panolog.partition import plan_json
from panolog.partition.bounds import Aabb
from panolog.partition.cells import Grid
from panolog.partition.config import PartitionConfig
from panolog.partition.plan import Plan
from panolog.scene.errors import InputError

_MOST = 1_000_000_000  # bytes of plan.json at most
_SCORES = re.compile(rb'"scores": \[[^\[\]"]*\]')  # a name cannot look like it: its quotes are escaped


def read_plan(place: Place) -> Plan:
    """The plan of a run. Raises InputError if there is none or it contradicts itself."""
    folder = place.folder
    with opened(folder.scores, folder.root) as file, np.load(file, allow_pickle=False) as arrays:
        rows, scores = arrays["cameras"], arrays["scores"]
    text = _SCORES.sub(b'"scores": []', read_below(folder.plan, folder.root, _MOST))
    try:
        data = plan_json.parse(json.loads(text))
    except ValueError as error:
        raise InputError(f"plan.json: is not JSON: {error}") from error
    if tuple(camera.row for camera in data.cameras) != tuple(rows.tolist()):
        raise InputError("scores.npz: is of other cameras than plan.json")
    with plan_json.contradictions():
        return Plan(
            config=PartitionConfig(rho_tri=data.rho_tri, tau_grad=data.tau_grad),
            grid=Grid(data.grid),
            baseline=data.baseline,
            aabb=Aabb(np.array(data.aabb.lower), np.array(data.aabb.upper)),
            rows=tuple(camera.row for camera in data.cameras),
            names=tuple(camera.name for camera in data.cameras),
            centers=np.array([camera.center for camera in data.cameras], np.float64).reshape(-1, 3),
            scores=np.asarray(scores, np.float64),
            gaussians=np.array([block.gaussians for block in data.blocks], np.int64),
        )


def map_of(place: Place, summary: dict[str, Any]) -> dict[str, Any]:
    """The map from above. Raises InputError if there is no plan yet or it cannot be read."""
    plan = read_plan(place)
    return map_figure(plan, _points(place), standings_of(summary))


def _points(place: Place) -> NDArray[np.floating[Any]]:
    """(P, 3) of the scene: the Gaussians of Stage I, if they are still there."""
    folder = place.folder
    try:
        with opened(folder.model("coarse"), folder.root) as file:
            return read_points(by_handle(file.fileno()))
    except InputError:
        return np.empty((0, 3), np.float32)


def camera_of(place: Place, row: int) -> dict[str, Any] | None:
    """One camera of the plan, its scores and why it trains which blocks; None if it trains none."""
    plan = read_plan(place)
    if row not in plan.rows:
        return None
    k = plan.rows.index(row)
    camera = plan.camera_json(k)
    return camera.model_dump(mode="json", exclude={"center"})
