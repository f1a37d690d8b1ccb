"""A square whose four sides look the same, as verified matches in a database: nothing is rendered."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.consistency.solution import Solution
from panolog.prepare.sfm.consistency.solve import Solver
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.scene.projection import project_to_fractions
from panolog.scene.write import no_progress

Array = NDArray[np.float64]
SIZE = (1024, 512)
_SIDE, _ROUND = 12.0, 8.0  # metres from the middle to the fronts, and to the way
_SEEN, _NEAR, _ALIKE = 22.0, 4.5, 1.6  # metres to points, between neighbours, to where a place looks the same
_NOISE = 0.3  # pixels
_FRONT, _FLOOR = 130, 450  # points of each front, and of the ground
_ANY_LIGHT = 0.25  # of the points, those that look the same in another light


@dataclass(frozen=True, eq=False)
class Place:
    """Panoramas on a way, and what they share."""

    centers: Array  # (K, 3)
    work: Workspace


def parts_of(place: Place) -> list[Solution]:
    """What is found of a place, of at least three panoramas, the largest part first."""
    with silence_colmap():
        return Solver(place.work, SIZE, "incremental", 2.0, no_progress).parts(3)


def square(
    folder: Path,
    *,
    count: int = 32,
    ground: float = 1.0,
    order: NDArray[np.int64] | None = None,
    again: float = 0.0,
    dusk: int | None = None,
    points: float = 1.0,
) -> Place:
    """Args: count, places on the way; points and ground, how many in all, and of the ground, which does not
    repeat, in parts of the usual number; order, (K,) which of these places panoramas have, in the order of
    their names; again, metres from a place to where a later panorama of it stands; dusk, the first of the
    panoramas that are taken in another light.
    """
    random = np.random.default_rng(1)
    where, copy_of = _points(random, round(_FRONT * points), round(_FLOOR * points * ground))
    centers, rotations = _way(random, count)
    if order is not None:
        first = np.isin(np.arange(len(order)), np.unique(order, return_index=True)[1])
        centers, rotations = centers[order], rotations[order]
        centers[~first, :2] += again * np.array([0.6, 0.8])
    late = np.arange(len(centers)) >= (len(centers) if dusk is None else dusk)
    keypoints, rows = [], []
    for center, rotation in zip(centers, rotations, strict=True):
        seen = np.flatnonzero(np.linalg.norm(where - center, axis=1) < _SEEN)
        pixels = project_to_fractions((where[seen] - center) @ rotation.T) * SIZE
        keypoints.append(pixels + random.normal(0, _NOISE, pixels.shape))
        rows.append(seen)
    look = np.where(copy_of >= 0, copy_of, len(where)).min(axis=0)  # of a point and of what looks like it
    same = np.random.default_rng(2).random(len(where))[look] < _ANY_LIGHT
    pairs = {}
    for a in range(len(centers)):
        for b in range(a + 1, len(centers)):
            for turn in range(4):
                turned = Rotation.from_euler("z", 90 * turn, degrees=True).apply(centers[a])
                if np.linalg.norm(turned - centers[b]) < (_ALIKE if turn else _NEAR):
                    matches = _matches(rows[a], rows[b], copy_of[turn])
                    pairs[a, b] = matches[(late[a] == late[b]) | same[rows[a][matches[:, 0]]]]
                    break
    changed = [late_ & ~same[seen] for late_, seen in zip(late, rows, strict=True)]
    return write_place(folder, centers, keypoints, [look[seen] for seen in rows], pairs, changed, random)


def write_place(
    folder: Path,
    centers: Array,
    keypoints: list[Array],
    looks: list[NDArray[np.int64]],
    pairs: dict[tuple[int, int], NDArray[np.int64]],
    changed: list[NDArray[np.bool_]],
    random: np.random.Generator,
) -> Place:
    """Args: keypoints (N, 2) of each panorama in pixels; looks (N,) of each, equal numbers look the same;
    pairs, their verified matches (M, 2); changed (N,), which keypoints are seen in another light.
    """
    work = database_of(folder, keypoints)
    ids = work.ids()
    words = random.integers(0, 90, (1 + max(int(it.max()) for it in looks), 128)).astype(np.float64)
    words = (512 * words / np.linalg.norm(words, axis=1, keepdims=True)).round().astype(np.uint8)
    with pycolmap.Database.open(work.database) as database:
        for number, look, other in zip(ids, looks, changed, strict=True):
            own = np.where(other[:, None], 255 - words[look], words[look])
            features = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, own)
            database.write_descriptors(number, features)
        for (a, b), matches in pairs.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches.astype(np.uint32)
            database.write_two_view_geometry(ids[a], ids[b], geometry)
    return Place(centers, work)


def _points(random: np.random.Generator, front: int, ground: int) -> tuple[Array, NDArray[np.int64]]:
    """(P, 3), and (4, P) which point looks like each after so many quarter turns, -1 if none does."""
    one = np.column_stack(
        [random.uniform(-_SIDE, _SIDE, front), np.full(front, _SIDE), random.uniform(0, 9, front)]
    )
    sides = np.concatenate(
        [Rotation.from_euler("z", 90 * turn, degrees=True).apply(one) for turn in range(4)]
    )
    rows = np.arange(len(sides))
    copies = np.stack([(rows + turn * len(one)) % len(sides) for turn in range(4)])
    floor = np.column_stack([random.uniform(-_SIDE, _SIDE, (ground, 2)), random.uniform(-0.1, 0.3, ground)])
    alone = np.full((4, len(floor)), -1)
    alone[0] = len(sides) + np.arange(len(floor))
    return np.concatenate([sides, floor]), np.concatenate([copies, alone], axis=1)


def _way(random: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Centres (K, 3) on a square with rounded corners, not quite closed, and world-to-camera (K, 3, 3)."""
    angle = np.linspace(0, 1.94 * np.pi, count)
    reach = _ROUND / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle))) ** 0.6
    centers = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.full(count, 1.6)])
    centers += random.normal(0, 0.06, centers.shape)
    return centers, upright(angle + np.pi / 2 + random.normal(0, 0.05, count))


def upright(heading: Array) -> Array:
    """World-to-camera (K, 3, 3) of upright cameras, heading (K,) radians from x."""
    level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    rotations: Array = level @ Rotation.from_euler("z", heading[:, None]).inv().as_matrix()
    return rotations


def _matches(one: NDArray[np.int64], other: NDArray[np.int64], copy: NDArray[np.int64]) -> NDArray[np.int64]:
    """(M, 2) places in the lists of points of two panoramas, the second's the copies of the first's."""
    place = np.full(len(copy) + 1, -1)
    place[other] = np.arange(len(other))
    there = place[copy[one]]
    return np.column_stack([np.flatnonzero(there >= 0), there[there >= 0]])


def database_of(folder: Path, keypoints: list[Array]) -> Workspace:
    """The workspace of empty panoramas with keypoints (K, 2) in pixels, and nothing else."""
    folder.mkdir(parents=True, exist_ok=True)
    empty = cv2.imencode(".png", np.zeros(SIZE[::-1], np.uint8))[1].tobytes()
    panoramas = []
    for row in range(len(keypoints)):
        file = folder / f"{row:03d}.png"
        file.write_bytes(empty)
        panoramas.append(PanoramaFile(folder, file.name, file))
    work = Workspace(folder / "work", tuple(panoramas))
    work.open(None)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "EQUIRECTANGULAR"
    pycolmap.Database.open(work.database).close()
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.import_images(work.database, work.images, mode, work.numbers, options=reader)
    ids = work.ids()
    with pycolmap.Database.open(work.database) as database:
        for number, pixels in zip(ids, keypoints, strict=True):
            database.write_keypoints(number, pixels.astype(np.float32))
    return work
