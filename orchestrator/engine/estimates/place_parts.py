"""The parts of a place before anything is trained: what its districts, blocks and shards have and see."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.runs.config import RunConfig
from panolog.partition.assignment import OVERLAP
from panolog.partition.contraction import contract
from panolog.partition.districts import Districts, make_districts
from panolog.partition.levels import expected_cut
from panolog.scene.model import Scene
from panolog.workers.capture.movers import state_bytes
from panolog.workers.capture.pose_fit import STEPS
from panolog.workers.evaluation import FACES
from panolog.workers.scoring import shards_of
from panolog.workers.training.initialise import points_of, scene_length

_SHARDS = 4  # of whose cameras what they distinguish is estimated
_AROUND = 1 + FACES  # blocks around the faces of a shard


def districts_of(scene: Scene, config: RunConfig) -> Districts:
    """The districts of a job, or as many as there are cameras for. Raises as `make_districts`."""
    partition, centers = config.partition, scene.centers[list(scene.train)]
    return make_districts(
        centers,
        scene.points,
        partition.box(centers),
        config.districts,
        partition.min_cameras,
        overlap=partition.rho_tri if config.overlap is None else config.overlap,
    )


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of one job, whose blocks are decided."""

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
    def points(self) -> int:
        """Sparse points that Stage I starts from; of several districts, those of the one with most."""
        return math.ceil(len(self.scene.points) * self.district[1])

    @property
    def mapped(self) -> bool:
        """Whether there are depth images, from which Stage I may start too."""
        return any(self.scene.panoramas[row].depth for row in self.scene.train)

    def learning(self, cameras: int) -> int:
        """Bytes of what Stage I learns about so many panoramas; of movers, all else is a few numbers."""
        return state_bytes(self.config.movers, cameras, self.width)

    @cached_property
    def share(self) -> float:
        """The share of the sparse points that the fullest cell has."""
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

    @property
    def seams(self) -> int:
        """Faces that are measured."""
        return min(self.config.eval.seams, self.faces)

    @property
    def fits(self) -> int:
        """Renderings by which the evaluation fits poses, at most."""
        return STEPS * len(self.scene.test) if self.config.poses.refine else 0

    def block_reads(self, gaussians: int, own: int) -> int:
        """Scene Gaussians of the file that the fullest block starts from.

        Args: gaussians of the whole place; own, those in its cell, neither with sky.
        """
        fullest = int(np.bincount(self._of_cameras).argmax())
        rows = np.array(self.scene.train)[self._of_cameras == fullest]
        others = self._of_points != fullest
        detail = self.config.stage2.detail
        return own + self._distinguished(gaussians - own, rows.tolist(), self.scene.points[others], detail)

    @cached_property
    def scored(self) -> Sequence[Sequence[int]]:
        """The rows of Scene.panoramas of each shard of scores."""
        return shards_of(self.scene.train, self.config.stage2.reduces)

    @cached_property
    def measured(self) -> Sequence[Sequence[int]]:
        """The panoramas of each shard of the evaluation that measures some; none where it is one task."""
        return () if self.config.measured_detail is None else shards_of(self.scene.test, reduces=True)

    @property
    def measures(self) -> int:
        """How many shards the evaluation has, those that measure seams too; 0 where it is one task."""
        faces = 0 if self.config.measured_detail is None else self.seams
        return len(self.measured) + math.ceil(faces / FACES)

    def scored_with(self, gaussians: int) -> int:
        """Scene Gaussians that a shard is scored with. Args: gaussians of the whole place."""
        return self._seen(gaussians, self.scored, self.config.stage2.detail)

    def measured_with(self, gaussians: int) -> tuple[int, int]:
        """The most Gaussians of a shard that measures panoramas, and of one for seams; 0 without one."""
        detail = self.config.measured_detail or 0.0
        around = [self.around] if self.seams else []
        return self._seen(gaussians, self.measured, detail), self._seen(gaussians, around, detail)

    def _seen(self, gaussians: int, shards: Sequence[Sequence[int]], detail: float) -> int:
        """Scene Gaussians of the shard whose cameras, by row, distinguish most, as far as some show it."""
        some, points = shards[:: max(1, len(shards) // _SHARDS)], self.scene.points
        return max((self._distinguished(gaussians, rows, points, detail) for rows in some), default=0)

    @cached_property
    def around(self) -> Sequence[int]:
        """The rows of training panoramas around the faces of a shard, where most of them are."""
        standing = np.bincount(self._of_cameras)
        centers, fullest = self.scene.centers[list(self.scene.train)], int(standing.argmax())
        middle = centers[self._of_cameras == fullest].mean(0)
        order = np.argsort(np.linalg.norm(centers - middle, axis=1), kind="stable")
        rows: list[int] = np.array(self.scene.train)[order[: _AROUND * standing[fullest]]].tolist()
        return rows

    def _distinguished(
        self, gaussians: int, rows: Sequence[int], points: NDArray[np.float64], detail: float
    ) -> int:
        """How many of the Gaussians cameras distinguish by levels of detail, if they are where points are."""
        if not self.config.stage2.reduces or gaussians <= 0 or not len(points):
            return max(gaussians, 0)
        angle, least = detail * 2 * math.pi / self.width, scene_length(self.scene)
        centers = self.scene.centers[list(rows)]
        cut = expected_cut(points, gaussians / len(points), centers, angle, least)
        return min(gaussians, math.ceil(cut))

    @cached_property
    def _of_cameras(self) -> NDArray[np.int64]:
        """(K,) the cells in which the training cameras stand."""
        return self._cells(self.scene.centers[list(self.scene.train)])

    @cached_property
    def _of_points(self) -> NDArray[np.int64]:
        """(P,) the cells of the sparse points."""
        return self._cells(self.scene.points)

    def _cells(self, places: NDArray[np.float64]) -> NDArray[np.int64]:
        box = self.config.partition.box(self.scene.centers[list(self.scene.train)])
        return self.config.grid.block_of(contract(places, box))
