"""Which cameras look at faces between blocks, and at planes within the blocks to compare them with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from panolog.partition.faces import Plane, between, cameras_at, planes_within
from panolog.partition.plan import Plan
from panolog.scene.model import Scene
from panolog.workers.seams.strips import Array, Look


@dataclass(frozen=True, eq=False)
class Looks:
    """The cameras at some faces of a plan."""

    faces: Mapping[Plane, Sequence[Look]]
    planes: Mapping[tuple[int, int], Mapping[Plane, Sequence[Look]]]  # within, by block and axis

    @classmethod
    def of(cls, scene: Scene, plan: Plan, faces: Sequence[Plane]) -> "Looks":
        """Chooses them."""
        keys = dict.fromkeys((block, face.axis) for face in faces for block in (face.below, face.above))
        planes = {
            key: {plane: _looks_at(scene, plan, plane) for plane in planes_within(plan, *key)} for key in keys
        }
        return cls({face: _looks_at(scene, plan, face) for face in faces}, planes)

    @property
    def all(self) -> list[Look]:
        """The looks at planes and then those at faces; a camera at several of them as often."""
        groups = [*self.planes.values(), self.faces]
        return [look for group in groups for found in group.values() for look in found]

    @property
    def rows(self) -> tuple[int, ...]:
        """The rows of Scene.panoramas among them, each once."""
        return tuple(dict.fromkeys(look.row for look in self.all if look.row is not None))

    @property
    def centers(self) -> Array:
        """(L, 3) where all stand, world units."""
        return np.array([look.center for look in self.all]).reshape(-1, 3)

    @property
    def renders(self) -> int:
        """How many images are rendered to measure the faces."""
        at_faces = sum(map(len, self.faces.values()))
        return 2 * (len(self.all) - at_faces) + 4 * at_faces


def _looks_at(scene: Scene, plan: Plan, face: Plane) -> list[Look]:
    """The cameras at a face, and at one between two blocks virtual ones between them."""
    cameras = cameras_at(plan, face)
    panoramas = {k: scene.panoramas[plan.rows[k]] for k in cameras}
    looks = [Look(panorama.rotation, panorama.center, plan.rows[k]) for k, panorama in panoramas.items()]
    if face.below != face.above:
        looks += [Look(panoramas[k].rotation, place) for k, place in between(plan, face, cameras)]
    return looks
