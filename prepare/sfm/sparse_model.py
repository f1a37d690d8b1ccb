"""Poses and points in our convention, converted from a COLMAP model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.world.similarity import Similarity
from panolog.scene.projection import project_to_fractions
from panolog.scene.write import Sightings


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Poses of some of the panoramas, and points."""

    rows: tuple[int, ...]  # of the panoramas, ascending
    rotations: NDArray[np.float64]  # (K, 3, 3) world-to-camera
    translations: NDArray[np.float64]  # (K, 3)
    points: NDArray[np.float64]  # (P, 3)
    sightings: tuple[Sightings, ...]  # of each panorama

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """(K, 3) camera centres."""
        found: NDArray[np.float64] = -np.einsum("kji,kj->ki", self.rotations, self.translations)
        return found

    def moved(self, similarity: Similarity) -> "SparseModel":
        """The model after its world was moved."""
        rotations, translations = similarity.poses(self.rotations, self.translations)
        points = similarity.points(self.points)
        return replace(self, rotations=rotations, translations=translations, points=points)

    def points_seen_by(self, views: int) -> int:
        """How many points are seen by at least `views` panoramas."""
        rows = np.concatenate([np.empty(0, np.int64), *(rows for rows, _ in self.sightings)])
        return int((np.bincount(rows, minlength=1) >= views).sum())

    def errors(self, width: int) -> list[NDArray[np.float64]]:
        """For each panorama (M,) the distances of its observations from their projected points, in pixels.

        Both axes are those of the image: u is not scaled by the cosine of the latitude.
        """
        found = []
        size = np.array([width, width // 2])
        for rotation, translation, (rows, where) in zip(
            self.rotations, self.translations, self.sightings, strict=True
        ):
            off = project_to_fractions(self.points[rows] @ rotation.T + translation) - where
            off[:, 0] -= np.rint(off[:, 0])  # across the seam
            found.append(np.linalg.norm(off * size, axis=1))
        return found


def from_colmap(model: pycolmap.Reconstruction, numbers: Sequence[str], size: tuple[int, int]) -> SparseModel:
    """Converts a COLMAP model.

    Args: numbers, the names of the panoramas in the model; size, (width, height) of each.
    """
    ids = sorted(model.points3D)
    points = np.array([model.points3D[number].xyz for number in ids], np.float64).reshape(-1, 3)
    of_id = {number: row for row, number in enumerate(ids)}
    by_name = {str(image.name): image for image in model.images.values() if image.has_pose}
    rows = tuple(row for row, name in enumerate(numbers) if name in by_name)
    poses = [by_name[numbers[row]].cam_from_world() for row in rows]
    return SparseModel(
        rows=rows,
        rotations=np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3),
        translations=np.array([pose.translation for pose in poses]).reshape(-1, 3),
        points=points,
        sightings=tuple(_sightings(by_name[numbers[row]], of_id, size) for row in rows),
    )


def _sightings(image: pycolmap.Image, of_id: dict[int, int], size: tuple[int, int]) -> Sightings:
    seen = [point for point in image.points2D if point.has_point3D()]
    where = np.array([point.xy for point in seen], np.float64).reshape(-1, 2) / size
    return np.array([of_id[point.point3D_id] for point in seen], np.int64), where
