"""G²PS in a run: from the scores on disk to plan.json and scores.npz."""

import math
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.orchestrator.run.records import BlockPlan, Noticed, PlanSaved, Record
from panolog.partition.audit import audit
from panolog.partition.bounds import aabb
from panolog.partition.contraction import contract
from panolog.partition.levels import make_levels
from panolog.partition.plan import Plan, make_plan
from panolog.scene.errors import RunError
from panolog.scene.files import atomic
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import write_ply_parts
from panolog.workers.tasks import PLAN
from panolog.workers.training.initialise import scene_length

_LOW_PASS = 1.2 * math.sqrt(
    0.3
)  # pixels: the renderer's filter, where cubes are 1 to 2 times as far as need be


def block_labels(scene: Scene, coarse: Gaussians, config: RunConfig) -> NDArray[np.int64]:
    """(N - sky,) the block of each scene Gaussian of the Stage I model (eqs. 7-9)."""
    box = aabb(scene.centers[list(scene.train)], config.partition.rho_tri)
    return config.grid.block_of(contract(coarse.means[coarse.scene].numpy(), box))


def decide_plan(scene: Scene, coarse: Gaussians, scores: NDArray[np.float64], config: RunConfig) -> Plan:
    """The partition (eqs. 7-11) from scores (K, B) of the training cameras, in their order."""
    return make_plan(
        scene.centers[list(scene.train)],
        coarse.means[coarse.scene].numpy(),
        scores,
        config.grid,
        config.partition,
        rows=scene.train,
        names=[scene.panoramas[row].name for row in scene.train],
    )


def write_plan(folder: RunFolder, plan: Plan) -> None:
    """Writes scores.npz and plan.json."""
    folder.scores.parent.mkdir(parents=True, exist_ok=True)
    with atomic(folder.scores) as temporary, temporary.open("wb") as file:
        np.savez(file, cameras=np.array(plan.rows, np.int64), scores=plan.scores)
    write_json(folder.plan, plan.to_json())


def join_scores(shards: Sequence[Path], cameras: Sequence[int]) -> NDArray[np.float64]:
    """(K, B) scores of all training cameras from the files of their shards.

    Raises RunError if the files hold other cameras.
    """
    parts = [np.load(path) for path in shards]
    found = np.concatenate([part["cameras"] for part in parts]).tolist()
    if found != list(cameras):
        raise RunError(f"the scores in {shards[0].parent} are of other cameras; remove the folder and resume")
    return np.concatenate([part["scores"] for part in parts])


def plan_records(folder: RunFolder, plan: Plan, passes: tuple[tuple[str, ...], ...] = ()) -> list[Record]:
    """The records of a plan, and of the tasks of the passes that follow its blocks."""
    cameras = plan.assignment.assigned.sum(axis=0).tolist()
    blocks = tuple(
        BlockPlan(block, seen, count, train=train)
        for block, (seen, count, train) in enumerate(
            zip(cameras, plan.gaussians.tolist(), plan.trained.tolist(), strict=True)
        )
    )
    notices = [Noticed(PLAN, line) for line in audit(plan)]
    return [*notices, PlanSaved(folder.relative(folder.plan), blocks, passes)]


class Surroundings:
    """What blocks start from, and are scored with, where others are reduced to what cameras can distinguish.

    That depends on the Stage I model and the settings alone, so no file of it has to be kept.
    """

    def __init__(self, scene: Scene, coarse: Gaussians, config: RunConfig, width: int) -> None:
        """Makes the levels of detail of all blocks. Args: width of the panoramas."""
        self._scene, self._coarse = scene, coarse
        self._angle = config.stage2.detail * 2 * math.pi / width
        labels, side = block_labels(scene, coarse, config), self._angle * scene_length(scene)
        rows = torch.arange(len(coarse))
        scenery, self._sky = coarse.select(rows < coarse.scene.stop), coarse.select(rows >= coarse.scene.stop)
        blocks = (torch.from_numpy(labels == block) for block in range(config.grid.count))
        low_pass = _LOW_PASS / config.stage2.detail
        self._levels = [make_levels(scenery.select(block), side, low_pass) for block in blocks]

    @property
    def sizes(self) -> tuple[int, ...]:
        """(B,) Gaussians of each block."""
        return tuple(levels.own for levels in self._levels)

    def write_seen(self, path: Path, cameras: Iterable[int]) -> NDArray[np.int64]:
        """Writes what cameras distinguish of all blocks, and the sky; returns (N - sky,) whose each is.

        Args: cameras, rows of the scene's panoramas. Raises OSError if the file cannot be written.
        """
        centers = self._scene.centers[list(cameras)]
        parts = [levels.rows(levels.cut(centers, self._angle)) for levels in self._levels]
        counts = list(map(len, parts))
        count, sky, exact = sum(counts) + len(self._sky), len(self._sky), self._coarse.exact
        write_ply_parts(path, [*parts, self._sky], count=count, sky=sky, exact=exact)
        return np.repeat(np.arange(len(parts)), counts)

    def write(self, path: Path, blocks: Collection[int], cameras: Iterable[int]) -> None:
        """Writes what blocks start from: their own Gaussians, and as sky what cameras see of all others.

        Args: cameras, rows of the scene's panoramas. Raises OSError if the file cannot be written.
        """
        centers = self._scene.centers[list(cameras)]
        parts = [self._levels[block].rows(np.arange(self._levels[block].own)) for block in sorted(blocks)]
        scenery = sum(map(len, parts))
        for other, levels in enumerate(self._levels):
            if other not in blocks:
                parts.append(_frozen(levels.rows(levels.cut(centers, self._angle))))
        parts.append(self._sky)
        count = sum(map(len, parts))
        write_ply_parts(path, parts, count=count, sky=count - scenery, exact=self._coarse.exact)


def _frozen(gaussians: Gaussians) -> Gaussians:
    """The same, called sky: they neither train nor densify."""
    return gaussians.with_tensors(gaussians.tensors(), sky=len(gaussians))
