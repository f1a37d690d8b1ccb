"""What pages show of a run's plan, or before there is one of its outline: the map, cameras, and blocks."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from panolog.orchestrator.runs.folder import RunFolder, by_handle, opened
from panolog.orchestrator.watch.views.comparison.measured import read_seams
from panolog.orchestrator.watch.views.plan_map import Figure, map_figure, read_points
from panolog.orchestrator.watch.views.summary import Text, ViewModel
from panolog.partition.plan import Plan
from panolog.partition.plan_json import Reason
from panolog.partition.scores import read_scores
from panolog.scene.errors import InputError
from panolog.workers.seams.schema import by_blocks
from panolog.workers.tasks import COARSE

_MOST = 200_000_000  # bytes of a file at most
_WAY = "put back a copy of it, or remove it to see the run without its plan"


class CameraView(ViewModel):
    """GET …/camera/{row}: a training panorama of the plan.

    `scores` has one for each block, `assigned` why it trains which of them.
    """

    row: int
    name: Text
    block: int  # that it is in
    scores: tuple[float, ...]
    assigned: dict[int, Reason]
    no_picture: Text | None  # why its panorama cannot be shown


class BlockCamera(ViewModel):
    """A camera that trains a block, and which criterion chose it."""

    row: int
    name: Text
    reason: Reason


class BlockCameras(ViewModel):
    """GET …/block/{number}: the cameras that train a block."""

    block: int
    cameras: tuple[BlockCamera, ...]


def plan_of(folder: RunFolder) -> Plan:
    """The plan of a run, or its outline. Raises InputError if there is none or it contradicts itself."""
    return folder.parsed(folder.known_plan, _MOST, lambda raw: Plan.from_json(json.loads(raw)), _WAY)


def map_of(folder: RunFolder) -> Figure:
    """The map of a run from above. Raises InputError as `plan_of`, and if the seams are damaged."""
    seams = read_seams(folder)
    points = _points(folder, folder.model(COARSE), folder.outline_points)
    fixes, planned = _points(folder, folder.outline_fixes), folder.plan.exists()
    return map_figure(plan_of(folder), points, by_blocks(seams), planned=planned, fixes=fixes)


def _points(folder: RunFolder, *files: Path) -> NDArray[np.floating[Any]]:
    """(P, 3) of the first of some PLYs that can be read, such as the Gaussians of Stage I; else none."""
    for path in files:
        with suppress(InputError), opened(path, folder.root) as file:
            return read_points(by_handle(file.fileno()))
    return np.empty((0, 3), np.float32)


def scores_of(folder: RunFolder, plan: Plan) -> "scipy.sparse.csr_array | None":
    """(K, B) gradient scores of a plan; None of an outline. Raises InputError if they are damaged."""
    if not folder.plan.exists():
        return None
    with opened(folder.scores, folder.root) as file:
        return read_scores(file, plan.rows, plan.grid.count)


def view_camera(
    plan: Plan, k: int, scores: "scipy.sparse.csr_array | None", no_picture: str | None
) -> CameraView:
    """The k-th camera of a plan. Args: scores, `scores_of`; no_picture, why its panorama cannot be shown."""
    found = plan.camera_json(k).model_dump(exclude={"center"})
    if scores is None:
        return CameraView(**found | {"assigned": {}}, scores=(), no_picture=no_picture)
    return CameraView(**found, scores=tuple(scores[[k], :].toarray()[0].tolist()), no_picture=no_picture)


def cameras_of(plan: Plan, block: int) -> BlockCameras | None:
    """The cameras that train a block, by row; None if the plan has no such block."""
    if not 0 <= block < plan.grid.count:
        return None
    cameras = [
        BlockCamera(row=plan.rows[k], name=plan.names[k], reason=plan.reasons(k)[block])
        for k in plan.assignment.cameras_of(block)
    ]
    return BlockCameras(block=block, cameras=tuple(cameras))
