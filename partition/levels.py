"""Levels of detail of a block's Gaussians: what the cameras of other blocks see of it.

The Gaussians of a block stand in cubes, twice as large on each level as on the one below. What is smaller
than its cube is merged into one Gaussian, what is larger stays. A camera for which a cube spans less than a
pixel or two cannot distinguish its content from the Gaussians below. The number of those that a camera needs
grows with the logarithm of the size of a place, not with its area.

Cubes never hold Gaussians of two blocks, so that a block's own are apart from those of all others. After
"A Hierarchical 3D Gaussian Representation" (Kerbl et al. 2024), which merges by the same moments.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from panolog.scene.gaussians import Gaussians, concatenate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_BITS = 20  # of a coordinate in the smallest cubes; what lies beyond is never merged
_MOST_OPACITY = 0.999
_LEAST_VARIANCE = 1e-20
_SAMPLE = 50_000  # points from which it is estimated how many Gaussians a cut has
_AROUND = 4  # neighbours by whose distance the area is estimated that a point stands for
_MERGING = 7  # distances between Gaussians from which on a cube merges them: trained ones are large
_FINER = 3 / np.log(4)  # mean of (limit / side)² where sides are powers of two below the limit
_PAIRS = 2**20  # of cubes and cameras whose distances are computed at a time


@dataclass(frozen=True, eq=False)
class Level:
    """The cubes of one level, in Morton order. Numbers of Gaussians are rows of `Levels`."""

    side: float  # of a cube, world units
    origin: Floats  # (3,) lower corner of the cube at 0, world units
    places: NDArray[np.int32]  # (C, 3) of the cubes, in sides from the origin
    starts: Ints  # (C + 1,) where the Gaussians of each cube begin, the next after the last
    children: Ints  # (C + 1,) where its cubes begin on the level below

    def corners(self, cubes: Ints) -> Floats:
        """(M, 3) lower corners of some cubes, world units."""
        return np.asarray(self.origin + self.places[cubes] * self.side)


@dataclass(frozen=True, eq=False)
class Levels:
    """A block's own Gaussians, and then those of each level above them; none is sky.

    What is not merged stands on several levels, and in memory once.
    """

    values: Mapping[str, NDArray[np.float32]]  # parameters of the own Gaussians and the merged ones
    exact: bool  # `Gaussians.exact`
    order: Ints  # (R,) which of them each row is
    levels: tuple[Level, ...]  # the first has the own Gaussians

    @property
    def own(self) -> int:
        """The number of the block's own Gaussians."""
        return int(self.levels[0].starts[-1])

    def rows(self, rows: Ints) -> Gaussians:
        """Some of them."""
        at = self.order[rows]
        tensors = {name: torch.from_numpy(values[at]) for name, values in self.values.items()}
        return Gaussians(**tensors, sky=0, exact=self.exact)

    def cut(self, centers: Floats, angle: float) -> Ints:
        """Rows of the fewest Gaussians of cubes that none of these cameras sees larger than `angle`.

        What they see larger is in the cut as it is. Args: centers (K, 3) in world units; angle in radians.
        """
        rows, cubes, cameras = [], np.arange(len(self.levels[-1].places)), cKDTree(centers)
        for level, below in zip(self.levels[::-1], (*self.levels[-2::-1], None), strict=True):
            seen = np.zeros(len(cubes), np.bool_)
            if below is not None:
                seen = _seen_larger(level.corners(cubes), level.side, cameras, angle)
            rows.append(_ranges(level.starts, cubes[~seen]))
            cubes = _ranges(level.children, cubes[seen])
        return np.sort(np.concatenate(rows))


def make_levels(gaussians: Gaussians, side: float, low_pass: float = 0.0, most: int = _BITS + 1) -> Levels:
    """All levels of a block, up to the one that has a single cube.

    Args: gaussians of one block, on the CPU, finite, without sky; side of the smallest cubes in world units;
    low_pass, standard deviation of the renderer's filter where a cube is just small enough, in sides of it;
    most levels above the block's own.
    """
    nodes = _Nodes(gaussians, side, low_pass)
    rows = np.argsort(_morton(nodes.place), kind="stable")
    cubes, starts = _cubes(nodes.place[rows])
    levels = [Level(side, nodes.origin, cubes.astype(np.int32), starts, np.zeros(len(starts), np.int64))]
    order = [rows]
    for step in range(most):
        below, offset = cubes >> (step > 0), levels[-1].starts[-1]
        rows = nodes.merge(rows, step)
        cubes, starts = _cubes(nodes.place[rows] >> step)
        places = cubes.astype(np.int32)
        levels.append(Level(side * 2.0**step, nodes.origin, places, offset + starts, _cubes(below)[1]))
        order.append(rows)
        if len(cubes) <= 1:
            break
    values = {name: tensor.numpy() for name, tensor in nodes.gaussians.tensors().items()}
    return Levels(values, gaussians.exact, np.concatenate(order), tuple(levels))


def expected_cut(points: Floats, each: float, centers: Floats, angle: float, least: float) -> float:
    """How many Gaussians a cut has of a model that is not there yet: `each` for every one of these points.

    Points are taken to lie on surfaces. Of the area that one stands for, by the distance of its neighbours,
    the cut has as many Gaussians as cubes, where these are large enough to merge any. Sides are powers of 2.

    Args: points (P, 3), centers (K, 3) of the cameras, least distance of what is merged: world units; angle
    as in `Levels.cut`.
    """
    if not len(points):
        return 0.0
    step = -(-len(points) // _SAMPLE)
    some = points[::step]
    apart = cKDTree(some).query(some, k=_AROUND + 1)[0][:, -1]  # inf where there are not so many
    area, side = np.pi / _AROUND * apart**2, angle * cKDTree(centers).query(some)[0].clip(min=least)
    count = each * step
    merged = _FINER * area / side**2
    return float(np.where(side > _MERGING * np.sqrt(area / count), np.minimum(merged, count), count).sum())


class _Nodes:
    """The Gaussians of a block and all that they are merged into, by number."""

    def __init__(self, gaussians: Gaussians, side: float, low_pass: float) -> None:
        """Only the block's own. Args: as `make_levels`."""
        means = gaussians.means.numpy().astype(np.float64)
        middle = np.median(means, axis=0) if len(means) else np.zeros(3)
        self.origin = np.maximum(means.min(axis=0, initial=np.inf), middle - 2 ** (_BITS - 1) * side)
        place = np.floor((means - self.origin) / side)
        self.gaussians, self.side, self.low_pass = gaussians, side, low_pass
        self.light = Light.of(gaussians)
        self.place = place.clip(0, 2**_BITS - 1).astype(np.int64)  # (N, 3) in smallest cubes from the origin
        within = (place == self.place).all(1)
        self.sizes = np.where(within, np.exp(gaussians.scales.numpy().max(1, initial=-np.inf)), np.inf)

    def merge(self, rows: Ints, step: int) -> Ints:
        """Makes the nodes of a level; returns their rows. Args: rows of the level below, cube by cube."""
        _, starts = _cubes(self.place[rows] >> step)
        cube = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        side = self.side * 2.0**step
        small = 2 * self.sizes[rows] <= side
        small &= np.bincount(cube[small], minlength=len(starts))[cube] > 1
        if not small.any():
            return rows
        parts, begins = rows[small], np.flatnonzero(np.diff(cube[small], prepend=-1))
        light = self.light.rows(parts)
        merged = merge_moments(_rows(self.gaussians, parts), begins, light, self.low_pass * side)
        new = len(self.place) + np.arange(len(begins))
        self.gaussians = concatenate(self.gaussians, merged)
        self.light = self.light.followed(light.joined(begins))
        self.place = np.concatenate([self.place, self.place[parts[begins]]])
        self.sizes = np.concatenate([self.sizes, np.exp(merged.scales.numpy().max(1))])
        order = np.argsort(np.concatenate([cube[small][begins], cube[~small]]), kind="stable")
        return np.concatenate([new, rows[~small]])[order]


@dataclass(frozen=True, eq=False)
class Light:
    """How much light Gaussians stop; sums of those that they stand for.

    The projected area of an ellipsoid, averaged over all directions, is about π/2 · (xy + yz + zx) for half
    axes x, y, z. A renderer's low-pass filter adds f² to the square of each, so for half axes that differ
    little 3f² to the sum.
    """

    stopped: Floats  # (N,) Σ opacity · (xy + yz + zx)
    opacity: Floats  # (N,) Σ opacity

    @classmethod
    def of(cls, gaussians: Gaussians) -> "Light":
        """The light that Gaussians stop which stand for themselves."""
        opacity = 1 / (1 + np.exp(-gaussians.opacities.numpy().astype(np.float64)))
        return cls(opacity * _area(np.exp(gaussians.scales.numpy().astype(np.float64))), opacity)

    def rows(self, rows: Ints) -> "Light":
        """The light of some rows."""
        return Light(self.stopped[rows], self.opacity[rows])

    def followed(self, other: "Light") -> "Light":
        """The light of these rows, and then of others."""
        both = zip((self.stopped, self.opacity), (other.stopped, other.opacity), strict=True)
        return Light(*map(np.concatenate, both))

    def joined(self, begins: Ints) -> "Light":
        """The light of each run of rows."""
        return Light(np.add.reduceat(self.stopped, begins), np.add.reduceat(self.opacity, begins))

    def seen(self, low_pass: float) -> Floats:
        """(N,) what they stop behind a low-pass filter with the standard deviation f, world units."""
        return np.asarray(self.stopped + 3 * low_pass**2 * self.opacity)


def merge_moments(parts: Gaussians, begins: Ints, light: Light, low_pass: float = 0.0) -> Gaussians:
    """One Gaussian for each run of rows, with the mean, covariance and mean colour of the run.

    Each row counts by the light that it stops. The one stops as much as they do at random places in an area
    twice its own, of which they cover 1 − exp(−Σ / 2A): by its opacity, and where that is not enough by being
    larger.

    Args: begins (R,) rows where the runs begin, ascending from 0; light of the rows; low_pass as
    in `Light.seen`.
    """
    values = {name: tensor.numpy().astype(np.float64) for name, tensor in parts.tensors().items()}
    runs, seen = np.diff(np.append(begins, len(parts))), light.seen(low_pass)
    total = np.add.reduceat(seen, begins)
    share = seen / np.repeat(total, runs)

    def mean(of_rows: Floats) -> Floats:
        weights = share.reshape(-1, *(1 for _ in of_rows.shape[1:]))
        return np.asarray(np.add.reduceat(of_rows * weights, begins))

    means = mean(values["means"])
    apart = (values["means"] - np.repeat(means, runs, axis=0))[:, :, None]
    turns, sizes = Rotation.from_quat(values["quats"], scalar_first=True), np.exp(values["scales"])
    axes = turns.as_matrix() * sizes[:, None]
    covariances = mean(axes @ axes.transpose(0, 2, 1) + apart @ apart.transpose(0, 2, 1))
    variances, frames = np.linalg.eigh(covariances)
    frames[np.linalg.det(frames) < 0, :, 0] *= -1
    variances = variances.clip(_LEAST_VARIANCE)
    covered = -2 * np.expm1(total / (_area(np.sqrt(variances)) + 3 * low_pass**2) / -2)
    opacities = np.minimum(covered, _MOST_OPACITY)
    larger = (covered / opacities)[:, None]
    merged = {
        "means": means,
        "quats": Rotation.from_matrix(frames).as_quat(scalar_first=True),
        "scales": 0.5 * np.log(larger * (variances + low_pass**2) - low_pass**2),
        "opacities": np.log(opacities / (1 - opacities)),
        "sh0": mean(values["sh0"]),
        "shN": mean(values["shN"]),
    }
    singles = {name: torch.from_numpy(array.astype(np.float32)) for name, array in merged.items()}
    return parts.with_tensors(singles, sky=0)


def _area(scales: Floats) -> Floats:
    """(N,) of ellipsoids with half axes (N, 3), see `Light`."""
    x, y, z = scales.T
    return np.asarray(x * y + y * z + z * x)


def _seen_larger(corners: Floats, side: float, cameras: cKDTree, angle: float) -> Bools:
    """(C,) whether the nearest camera sees a cube larger than an angle.

    The camera nearest to its middle decides that at once, unless the cube is close to the limit.
    """
    middle, _ = cameras.query(corners + side / 2)
    seen = middle * angle < side
    unsure = np.flatnonzero(~seen & ((middle - side) * angle < side))
    seen[unsure] = _distances(corners[unsure], side, cameras.data) * angle < side
    return np.asarray(seen)


def _distances(corners: Floats, side: float, centers: Floats) -> Floats:
    """(C,) from cubes to the nearest of the cameras (K, 3)."""
    nearest, step = np.empty(len(corners)), max(1, _PAIRS // max(1, len(centers)))
    for start in range(0, len(corners), step):
        lower = corners[start : start + step, None]
        apart = np.maximum(np.maximum(lower - centers, centers - lower - side), 0)
        nearest[start : start + step] = np.sqrt(np.square(apart).sum(2).min(1))
    return nearest


def _morton(place: Ints) -> Ints:
    """(N,) numbers with the bits of coordinates (N, 3) in turn."""
    numbers = np.zeros(len(place), np.int64)
    for bit in range(_BITS):
        for axis in range(3):
            numbers |= (place[:, axis] >> bit & 1) << (3 * bit + axis)
    return numbers


def _cubes(place: Ints) -> tuple[Ints, Ints]:
    """The runs of equal rows of (N, 3): the row (C, 3) of each, and where they begin and the last ends."""
    new = np.ones(len(place), np.bool_)
    new[1:] = (place[1:] != place[:-1]).any(1)
    starts = new.nonzero()[0]
    return place[starts], np.append(starts, len(place))


def _ranges(bounds: Ints, chosen: Ints) -> Ints:
    """All numbers from bounds[i] to bounds[i + 1], for each chosen i."""
    counts = bounds[chosen + 1] - bounds[chosen]
    return np.repeat(bounds[chosen] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def _rows(gaussians: Gaussians, rows: Ints) -> Gaussians:
    at = torch.from_numpy(rows)
    return gaussians.with_tensors({name: tensor[at] for name, tensor in gaussians.tensors().items()}, sky=0)
