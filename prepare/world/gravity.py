"""Which way is up, and north, in an SfM result: from the attitudes in the files, or else from the cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.world.exif import Attitude

Array = NDArray[np.float64]

_ENOUGH = 3  # attitudes; fewer only if there are no more cameras
_PART = 0.25  # of the cameras must have an attitude
_AS_GOOD = 2.0  # degrees by which attitudes may differ more than the cameras' own axes: noise of sensors
_NORTH = 20.0  # degrees by which compasses may differ from the poses: indoors they are off by more
_CANDIDATES = 256  # directions that are tried as a first guess
_ITERATIONS = 50
_TAIL = 2.0  # times the median angle: directions that are further off weigh less than a quarter


@dataclass(frozen=True, eq=False)
class UpDirection:
    """The common up of the cameras."""

    direction: Array  # (3,) unit, in world axes
    spread: float  # degrees; half of the cameras are closer to it
    source: Literal["files", "cameras"]
    cameras: int  # that it was found from


def find_up(rotations: Array, attitudes: Sequence[Attitude | None]) -> tuple[UpDirection, tuple[str, ...]]:
    """The up on which most cameras agree, and notes about it, one line each.

    The attitudes in the files are used, unless they fit the poses worse than level cameras would: programs
    that level a panorama often leave the attitude in it, and not all use the same signs.

    Args:
        rotations: (K, 3, 3) world-to-camera, x right, y down, z forward; at least one.
        attitudes: K, as `read_exif` gives them.
    """
    held = _agreement(-rotations[:, 1], "cameras")
    rows = [row for row, attitude in enumerate(attitudes) if attitude is not None]
    if len(rows) < max(min(_ENOUGH, len(rotations)), _PART * len(rotations)):
        return held, ()
    ups = np.stack([attitude.up for attitude in attitudes if attitude is not None])
    measured = _agreement(np.einsum("kji,kj->ki", rotations[rows], ups), "files")
    if measured.spread <= held.spread + _AS_GOOD:
        return measured, ()
    return held, (
        f"the attitudes in {len(rows)} files differ from the poses by {measured.spread:.1f} degrees, "
        f"level cameras would by {held.spread:.1f}: not used",
    )


def leveling(up: Array) -> Array:
    """(3, 3) the least rotation that takes the unit vector `up` (3,) to +z."""
    rotation, _ = Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), up[None])
    matrix: Array = rotation.as_matrix()
    return matrix


def find_north(rotations: Array, attitudes: Sequence[Attitude | None]) -> tuple[float, float, int] | None:
    """The turn that takes an upright world to one with y north, by the headings in the files.

    Args: rotations (K, 3, 3) world-to-camera, of a world with z up; attitudes, K, as `read_exif` gives them.

    Returns:
        Radians about z, counterclockwise from above; by how many degrees half of the headings differ, at
        most; and how many there are. None where there are too few, all are the same, as programs without a
        compass write them, or they do not agree with the poses.
    """
    known = [
        (row, it.heading) for row, it in enumerate(attitudes) if it is not None and it.heading is not None
    ]
    if len(known) < max(_ENOUGH, _PART * len(rotations)) or len({heading for _, heading in known}) < 2:
        return None
    forward = rotations[[row for row, _ in known], 2]  # (M, 3) the middle of each panorama, in the world
    azimuth = np.arctan2(forward[:, 0], forward[:, 1])  # clockwise from y
    turns = azimuth - np.deg2rad([heading for _, heading in known])
    directions = np.stack([np.cos(turns), np.sin(turns), np.zeros(len(turns))], axis=1)
    center = _robust_mean(directions)
    spread = float(np.median(_degrees(directions, center)))
    return (float(np.arctan2(center[1], center[0])), spread, len(known)) if spread <= _NORTH else None


def _agreement(directions: Array, source: Literal["files", "cameras"]) -> UpDirection:
    center = _robust_mean(directions)
    return UpDirection(center, float(np.median(_degrees(directions, center))), source, len(directions))


def _robust_mean(directions: Array) -> Array:
    """(3,) the unit vector that most of the unit vectors (N, 3) are close to; a third may be anything.

    Means reweighted as Geman and McClure do, from that one of them with the least median angle to all.
    """
    some = directions[:: -(-len(directions) // _CANDIDATES)]
    center: Array = min(some, key=lambda one: float(np.median(_degrees(directions, one))))
    for _ in range(_ITERATIONS):
        angles = _degrees(directions, center)
        weights = 1 / (1 + (angles / (_TAIL * np.median(angles) + 1e-9)) ** 2) ** 2
        mean = weights @ directions
        length = float(np.linalg.norm(mean))
        if length < 1e-9 * weights.sum():  # they cancel out: there is no better one nearby
            break
        center = mean / length
    return center


def _degrees(directions: Array, center: Array) -> Array:
    """(N,) angles between unit vectors (N, 3) and `center` (3,), exact also where they are small."""
    across = np.linalg.norm(np.cross(directions, center), axis=1)
    angles: Array = np.rad2deg(np.arctan2(across, directions @ center))
    return angles
