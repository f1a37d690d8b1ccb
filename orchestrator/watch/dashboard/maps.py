"""The map of a run's plan, and its cameras."""

import json
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.watch.dashboard.discovery import RunEntry, by_handle, opened, read_below
from panolog.orchestrator.watch.dashboard.messages import BlockCamera, BlockCameras
from panolog.orchestrator.watch.views.figures import Figure, map_figure
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.plan_map import read_points
from panolog.partition.plan import Plan
from panolog.partition.plan_json import PlanCamera
from panolog.partition.scores import read_scores
from panolog.scene.errors import InputError
from panolog.workers.seams.schema import by_blocks, parse_seams
from panolog.workers.tasks import COARSE

_MOST = 200_000_000  # bytes of plan.json at most
_CACHED = 4  # maps, of about a megabyte


def _read_plan(entry: RunEntry) -> Plan:
    """The plan of a run, or its outline. Raises InputError if there is none or it contradicts itself."""
    folder = entry.folder
    try:
        data = json.loads(read_below(folder.known_plan, folder.root, _MOST))
    except ValueError as error:
        raise InputError(f"plan.json: is not JSON: {error}") from error
    return Plan.from_json(data)


class MapCache:
    """The maps that were requested last."""

    def __init__(self) -> None:
        self._maps: OrderedDict[str, tuple[tuple[int, ...], bytes]] = OrderedDict()
        self._lock = Lock()

    def map_of(self, entry: RunEntry) -> bytes:
        """The map from above, as JSON; pages draw the status of blocks themselves.

        Raises InputError if there is no plan yet or it cannot be read.
        """
        with self._lock:
            stamp = _stamp(entry)
            known = self._maps.pop(entry.id, None)
            if known is None or known[0] != stamp:
                known = (stamp, encode(_figure(entry)))
            self._maps[entry.id] = known
            while len(self._maps) > _CACHED:
                self._maps.popitem(last=False)
            return known[1]


def _figure(entry: RunEntry) -> Figure:
    folder, seams = entry.folder, {}
    if folder.seams.exists():
        seams = dict(by_blocks(parse_seams(read_below(folder.seams, folder.root, _MOST))))
    planned = folder.plan.exists()
    points = _points(entry, folder.model(COARSE), folder.outline_points)
    fixes = _points(entry, folder.outline_fixes)
    return map_figure(_read_plan(entry), points, seams=seams, planned=planned, fixes=fixes)


def _stamp(entry: RunEntry) -> tuple[int, ...]:
    """A value that changes when the plan, the points or the seams do."""
    folder = entry.folder
    outlined = (folder.outline_points, folder.outline_fixes)
    files = (folder.known_plan, folder.model(COARSE), *outlined, folder.seams)
    stats = [path.stat() for path in files if path.exists()]
    return tuple(number for stat in stats for number in (stat.st_mtime_ns, stat.st_size))


def _points(entry: RunEntry, *files: Path) -> NDArray[np.floating[Any]]:
    """(P, 3) of the first of some PLYs that can be read, such as the Gaussians of Stage I; else none."""
    for path in files:
        with suppress(InputError), opened(path, entry.folder.root) as file:
            return read_points(by_handle(file.fileno()))
    return np.empty((0, 3), np.float32)


def camera_of(entry: RunEntry, row: int) -> PlanCamera | None:
    """One camera of the plan; None if the plan has no such row. Raises InputError if it cannot be read."""
    plan = _read_plan(entry)
    return plan.camera_json(plan.rows.index(row)) if row in plan.rows else None


def scored_camera_of(entry: RunEntry, row: int) -> tuple[PlanCamera, tuple[float, ...]] | None:
    """One camera of the plan with its gradient scores, one for each block; before there is a plan none.

    Returns None if there is no such row.
    """
    plan, folder = _read_plan(entry), entry.folder
    if row not in plan.rows:
        return None
    k = plan.rows.index(row)
    if not folder.plan.exists():
        return plan.camera_json(k).model_copy(update={"assigned": {}}), ()
    with opened(folder.scores, folder.root) as file:
        scores = read_scores(file, plan.rows, plan.grid.count)
    return plan.camera_json(k), tuple(scores[[k], :].toarray()[0].tolist())


def cameras_of(entry: RunEntry, block: int) -> BlockCameras | None:
    """The cameras that train a block, by row; None if the plan has no such block.

    Raises InputError if the plan cannot be read.
    """
    plan = _read_plan(entry)
    if not 0 <= block < plan.grid.count:
        return None
    cameras = [
        BlockCamera(row=plan.rows[k], name=plan.names[k], reason=plan.reasons(k)[block])
        for k in plan.assignment.cameras_of(block)
    ]
    return BlockCameras(block=block, cameras=tuple(cameras))


def require_camera(entry: RunEntry, name: str) -> None:
    """Raises InputError if the plan has no panorama of that name, or cannot be read."""
    if name not in _read_plan(entry).names:
        raise InputError("the plan of this run has no such panorama")
