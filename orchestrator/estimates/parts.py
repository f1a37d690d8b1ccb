"""The parts of a place before anything is trained: what its districts, blocks and shards have and see."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.run.config import RunConfig
from panolog.partition.assignment import OVERLAP
from panolog.partition.bounds import aabb
from panolog.partition.contraction import contract
from panolog.partition.districts import Districts, make_districts
from panolog.partition.levels import expected_cut
from panolog.scene.model import Scene
from panolog.workers.training.initialise import points_of, scene_length


def districts_of(scene: Scene, config: RunConfig) -> Districts:
    """The districts of a job, or as many as there are cameras for. Raises as `make_districts`."""
    partition = config.partition
    return make_districts(
        scene.centers[list(scene.train)],
        scene.points,
        partition.rho_tri,
        config.districts,
        partition.min_cameras,
        config.overlap,
    )


@dataclass(frozen=True, eq=False)
class Parts:
    """Those of one job, whose blocks are decided."""

    scene: Scene
    config: RunConfig
    width: int  # of the panoramas, pixels

    @cached_property
    def district(self) -> tuple[int, float]:
        """Cameras of the district that has most, and the largest share of the sparse points of one."""
        scene = self.scene
        if self.config.districts == 1:
            return len(scene.train), 1.0
        train, districts = np.array(scene.train), districts_of(scene, self.config)
        rows = [train[cameras].tolist() for cameras in districts.cameras]
        starts = [len(points_of(scene, row, districts.cell(i), self.width)) for i, row in enumerate(rows)]
        return int(districts.cameras.sum(axis=1).max()), max(starts) / len(scene.points)

    @cached_property
    def share(self) -> float:
        """Of the sparse points, the largest in one cell."""
        return float(np.bincount(self._of_points).max()) / len(self._of_points)

    @cached_property
    def block_cameras(self) -> int:
        """Training panoramas of the fullest block."""
        standing = int(np.bincount(self._of_cameras).max())
        return min(len(self.scene.train), math.ceil(OVERLAP * standing))

    @property
    def faces(self) -> int:
        """Between blocks: a square grid has 2 (n - √n)."""
        blocks = self.config.grid.count if self.config.refine else 1
        return round(2 * (blocks - math.sqrt(blocks)))

    def block_reads(self, gaussians: int, own: int) -> int:
        """Scene Gaussians of the file that the fullest block starts from.

        Args: gaussians of the whole place; own, those in its cell, neither with sky.
        """
        fullest = int(np.bincount(self._of_cameras).argmax())
        rows = np.array(self.scene.train)[self._of_cameras == fullest]
        others = self._of_points != fullest
        return own + self._distinguished(gaussians - own, rows.tolist(), self.scene.points[others])

    def shard_reads(self, gaussians: int, rows: Sequence[int]) -> int:
        """Scene Gaussians with which some cameras are scored. Args: gaussians of the whole place."""
        return self._distinguished(gaussians, rows, self.scene.points)

    def _distinguished(self, gaussians: int, rows: Sequence[int], points: NDArray[np.float64]) -> int:
        """Of so many Gaussians where these points are, what cameras need of their levels of detail."""
        stage2 = self.config.stage2
        if not stage2.reduces or gaussians <= 0 or not len(points):
            return max(gaussians, 0)
        angle, least = stage2.detail * 2 * math.pi / self.width, scene_length(self.scene)
        centers = self.scene.centers[list(rows)]
        return math.ceil(expected_cut(points, gaussians / len(points), centers, angle, least))

    @cached_property
    def _of_cameras(self) -> NDArray[np.int64]:
        """(K,) the cells in which the training cameras stand."""
        return self._cells(self.scene.centers[list(self.scene.train)])

    @cached_property
    def _of_points(self) -> NDArray[np.int64]:
        """(P,) the cells of the sparse points."""
        return self._cells(self.scene.points)

    def _cells(self, places: NDArray[np.float64]) -> NDArray[np.int64]:
        box = aabb(self.scene.centers[list(self.scene.train)], self.config.partition.rho_tri)
        return self.config.grid.block_of(contract(places, box))
