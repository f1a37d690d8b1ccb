"""A place before anything is trained, for those who watch: its cameras, some of its points, and GPS.

It is a plan of one block, so that whatever shows a plan shows it, too: map, cards of cameras, 3D view. While
poses are being found it grows with them.
"""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.export.earth import enu_to_ecef, geocentric
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import InputError
from panolog.scene.files import write_bytes
from panolog.scene.model import Scene
from panolog.scene.write import read_offset

_POINTS = 50_000  # at most: a map shows no more
_FIXES = 2_000  # panoramas whose files are looked into for GPS, at most

Array = NDArray[np.float64]


def write_outline(folder: RunFolder, scene: Scene, config: RunConfig, *, anew: bool = False) -> None:
    """Writes the outline of a run, unless it is there; none where the cameras bound no place.

    Args: anew, also if it is there, as from poses that were not final. Raises OSError if the disk is full.
    """
    if folder.outline.exists() and not anew:
        return
    train, points = list(scene.train), scene.points[:: -(-len(scene.points) // _POINTS) or 1]
    names = [scene.panoramas[row].name for row in train]
    _write(folder, config.partition, train, names, scene.centers[train], points, _fixes(scene))


def write_sketch(
    folder: RunFolder, names: Sequence[str], centers: Array, points: Array, fixes: Array
) -> None:
    """Writes what is known of a place while its poses are found; before there are any, where GPS has it.

    Args: as of `panolog.prepare.sfm.sketch.Sketch`. Raises OSError if the disk is full.
    """
    places, names = (centers, names) if len(names) else (fixes, [""] * len(fixes))
    _write(folder, RunConfig().partition, range(len(places)), names, places, points, fixes)


def _write(
    folder: RunFolder,
    config: PartitionConfig,
    rows: Sequence[int],
    names: Sequence[str],
    centers: Array,
    points: Array,
    fixes: Array,
) -> None:
    """Args: rows (K,) and names (K,) of the cameras, centers (K, 3), points (P, 3), fixes (F, 3) of GPS."""
    partition = config.model_copy(update={"cuts": ()})
    scores, grid = np.zeros((len(rows), 1)), Grid((1, 1, 1), partition.cells)
    try:
        plan = make_plan(centers, points, scores, grid, partition, rows=rows, names=names)
    except InputError:
        return  # what is wrong is said where it matters
    folder.make(folder.outline.parent)
    _write_points(folder.outline_points, points)
    _write_points(folder.outline_fixes, fixes)
    write_json(folder.outline, plan.to_json())


def _fixes(scene: Scene) -> Array:
    """(F, 3) where GPS has the panoramas, in the world of the run; none where that is not known."""
    place = None
    with suppress(InputError):  # what is wrong is said where it matters
        place = read_offset(scene.root)
    if place is None or (origin := place.origin) is None:
        return np.empty((0, 3))
    into_world = np.linalg.inv(enu_to_ecef(origin.latitude, origin.longitude, origin.altitude))
    found = list[Array]()
    for panorama in scene.panoramas[:: -(-len(scene.panoramas) // _FIXES)]:
        with suppress(InputError, OSError, ValueError):
            if (fix := read_exif(panorama.image).fix) is not None:
                height = origin.altitude if fix.altitude is None else fix.altitude
                place_of = geocentric(fix.latitude, fix.longitude, height)
                found.append(into_world[:3, :3] @ place_of + into_world[:3, 3])
    moved: Array = np.array(found).reshape(-1, 3) - np.array(place.offset) - np.array(scene.offset)
    return moved


def _write_points(path: Path, points: Array) -> None:
    """A PLY of positions alone. Args: points (P, 3)."""
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    write_bytes(path, head.encode() + points.astype("<f4").tobytes())
