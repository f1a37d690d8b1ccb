"""Other conventions for the same poses and points: which one would make them fit the panoramas."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from panolog.prepare.check.evidence import Array, Evidence, color_agreement, median_or_zero, offsets
from panolog.scene.projection import rays_of_fractions

GAIN, FIT = 0.15, 0.3  # least gain over ours, and least fit, of a convention that is reported
_PER_VIEW = 400  # points of each view that conventions are evaluated on
_VIEWS, _FEW, _PROMISING = 12, 3, 8  # all conventions are evaluated on few views, promising ones on more
_INLIER = 0.02  # radians between where a point is seen and where it should be
_AXES = {
    (1, -1, -1): "the cameras have y up and z backward (OpenGL, Blender, nerfstudio)",
    (-1, 1, -1): "longitude 0 is half a turn away: z points to the seam of the panoramas",
    (-1, -1, 1): "the cameras are upside down: x and y point the other way",
    (-1, 1, 1): "the scene is mirrored: left and right are exchanged",
    (1, -1, 1): "the scene is mirrored: up and down are exchanged (left-handed cameras with y up)",
    (1, 1, -1): "the scene is mirrored: front and back are exchanged",
    (-1, -1, -1): "the scene is mirrored through the cameras",
}


@dataclass(frozen=True, eq=False)
class Convention:
    """A convention of poses: X_cam = axes @ R @ (world @ X - C)."""

    description: str
    poses: str  # "as they are", "inverse" or "centres"
    axes: Array  # (3, 3) of the cameras, may mirror
    world: Array  # (3, 3) of the points, may mirror


def all_conventions() -> Iterator[Convention]:
    """Ours first."""
    identity = np.eye(3)
    yield Convention("as they are", "as they are", identity, identity)
    for axes in _signed_permutations():
        if not (axes == identity).all():
            yield Convention(_camera_axes(axes), "as they are", axes, identity)
            yield Convention(_world_axes(axes), "as they are", identity, axes)
        more = "" if (axes == identity).all() else f", and {_camera_axes(axes)}"
        yield Convention(
            f"the poses are camera-to-world, not world-to-camera{more}", "inverse", axes, identity
        )
        yield Convention(f"the translations are camera centres{more}", "centres", axes, identity)


def best_convention(evidence: Evidence, *, by_tracks: bool) -> tuple[Convention, float, float]:
    """(the best convention, how well it fits, how well ours does), by tracks or by colours.

    The fit is the median over some views: of the share of observations within `_INLIER`, or of the
    correlation between the colours of points and pixels.
    """
    every = list(all_conventions())
    rough = [convention_fit(evidence, convention, by_tracks=by_tracks, views=_FEW) for convention in every]
    promising = np.argsort(rough, kind="stable")[::-1][:_PROMISING].tolist()
    fits = {index: convention_fit(evidence, every[index], by_tracks=by_tracks) for index in {0, *promising}}
    best = max(sorted(fits), key=lambda index: fits[index])
    return every[best], fits[best], fits[0]


def convention_fit(
    evidence: Evidence, convention: Convention, *, by_tracks: bool, views: int = _VIEWS
) -> float:
    """How well a convention fits; see `best_convention`."""
    fits = []
    for view in range(0, len(evidence.views), -(-len(evidence.views) // views)):
        row = evidence.views[view]
        rotation, center = _pose(evidence, row, convention)
        thinned = slice(None, None, max(1, len(evidence.seen[row]) // _PER_VIEW))
        seen = evidence.seen[row][thinned]
        directions = (evidence.scene.points[seen] @ convention.world.T - center) @ rotation.T
        if by_tracks and evidence.pixels is not None:
            found = np.linalg.norm(
                rays_of_fractions(evidence.pixels[row][thinned] * (1, 2)) - _unit(directions), axis=1
            )
            fits.append(float((found < _INLIER).mean()) if len(found) else 0.0)
        else:
            fits.append(color_agreement(evidence, view, directions, seen))
    return median_or_zero(fits)


def _pose(evidence: Evidence, row: int, convention: Convention) -> tuple[Array, Array]:
    """(axes @ R, C) of a panorama in that convention."""
    panorama = evidence.scene.panoramas[row]
    rotation, translation = panorama.rotation, panorama.translation
    if convention.poses == "inverse":
        return convention.axes @ rotation.T, translation
    if convention.poses == "centres":
        return convention.axes @ rotation, translation
    return convention.axes @ rotation, -rotation.T @ translation


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    return unit


def _signed_permutations() -> Iterator[Array]:
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            yield matrix


def _camera_axes(axes: Array) -> str:
    """What the cameras' axes would be, as text."""
    if np.count_nonzero(np.diag(axes)) == 3:
        return _AXES.get(tuple(np.diag(axes).astype(int).tolist()), "the cameras' axes are ours")
    kind = "mirrored " if np.linalg.det(axes) < 0 else ""
    return f"the cameras' axes are {kind}others: our (x, y, z) are their ({_names(axes)})"


def _world_axes(axes: Array) -> str:
    kind = "a mirrored world" if np.linalg.det(axes) < 0 else "another world"
    return (
        f"the points are in {kind} than the poses: (x, y, z) of the poses are ({_names(axes)}) of the points"
    )


def _names(axes: Array) -> str:
    """Which axes the rows of a signed permutation take, such as `x, -z, y`."""
    words = []
    for row in axes:
        index = int(np.argmax(np.abs(row)))
        words.append(("-" if row[index] < 0 else "") + "xyz"[index])
    return ", ".join(words)


def residuals(evidence: Evidence) -> Array:
    """(N, 2) observed minus reprojected pixels of the panoramas, u shrunk by the cosine of the latitude."""
    if evidence.pixels is None:
        return np.empty((0, 2))
    found = []
    for row, (seen, pixels) in enumerate(zip(evidence.seen, evidence.pixels, strict=True)):
        apart = offsets(pixels, evidence.directions(row, evidence.scene.points[seen]))
        found.append(apart * evidence.scene.width)
    return np.concatenate(found)
