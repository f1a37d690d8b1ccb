"""A place before anything is trained, for those who watch: its cameras and some of its points.

It is a plan of one block, so that whatever shows a plan shows it, too: map, cards of cameras, 3D view.
"""

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.partition.cells import Grid
from panolog.partition.plan import make_plan
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes
from panolog.scene.model import Scene

_POINTS = 50_000  # at most: a map shows no more


def write_outline(folder: RunFolder, scene: Scene, config: RunConfig) -> None:
    """Writes the outline of a run, unless it is there; none where the cameras bound no place."""
    if folder.outline.exists():
        return
    train, points = list(scene.train), scene.points[:: -(-len(scene.points) // _POINTS) or 1]
    partition = config.partition.model_copy(update={"cuts": ()})
    names = [scene.panoramas[row].name for row in train]
    try:
        plan = make_plan(
            scene.centers[train],
            points,
            np.zeros((len(train), 1)),
            Grid((1, 1, 1), partition.cells),
            partition,
            rows=train,
            names=names,
        )
    except InputError:
        return  # what is wrong is said where it matters
    _write_points(folder, points)
    write_json(folder.outline, plan.to_json())


def _write_points(folder: RunFolder, points: NDArray[np.float64]) -> None:
    """A PLY of positions alone. Args: points (P, 3)."""
    folder.outline_points.parent.mkdir(parents=True, exist_ok=True)
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    write_bytes(folder.outline_points, head.encode() + points.astype("<f4").tobytes())
