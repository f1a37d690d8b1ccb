"""The plan of a run for its map. The scores of a thousand blocks are read as numbers, not as text."""

import json
import re
from collections import OrderedDict
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.dashboard.places import Place, by_handle, opened, read_below
from panolog.orchestrator.views.figures import map_figure
from panolog.orchestrator.views.map import read_points
from panolog.partition import plan_json
from panolog.partition.plan import Plan
from panolog.scene.errors import InputError

_MOST = 200_000_000  # bytes of plan.json at most
_KEPT = 4  # maps, of a megabyte or so
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
    return Plan.of_file(data, scores)


class Maps:
    """Maps that were asked for last, made once for all who look."""

    def __init__(self) -> None:
        self._maps: OrderedDict[str, tuple[tuple[int, ...], bytes]] = OrderedDict()
        self._one_at_a_time = Lock()

    def of(self, place: Place) -> bytes:
        """The map from above, as JSON; pages paint how the blocks stand themselves.

        Raises InputError if there is no plan yet or it cannot be read.
        """
        with self._one_at_a_time:
            stamp = _stamp(place)
            known = self._maps.pop(place.id, None)
            if known is None or known[0] != stamp:
                known = (stamp, encode(map_figure(read_plan(place), _points(place))))
            self._maps[place.id] = known
            while len(self._maps) > _KEPT:
                self._maps.popitem(last=False)
            return known[1]


def _stamp(place: Place) -> tuple[int, ...]:
    """What is different when the plan or the points are."""
    folder = place.folder
    stats = [path.stat() for path in (folder.plan, folder.model("coarse")) if path.exists()]
    return tuple(number for stat in stats for number in (stat.st_mtime_ns, stat.st_size))


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
    return plan.camera_json(plan.rows.index(row)).model_dump(mode="json", exclude={"center"})
