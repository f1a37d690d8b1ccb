"""G²PS in a run: from the scores of shards to plan.json and scores.npz."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.records import BlockPlan, Noticed, PlanSaved, Record
from panolog.partition.audit import audit
from panolog.partition.contraction import contract
from panolog.partition.plan import Plan, make_plan
from panolog.partition.scores import read_scores, write_scores
from panolog.scene.model import Scene
from panolog.workers.tasks import PLAN

_ROWS = 2**18  # Gaussians in a step


def block_labels(scene: Scene, means: NDArray[np.float32], config: RunConfig) -> NDArray[np.int64]:
    """(N,) the block of each of the scene Gaussians at means (N, 3) (eqs. 7-9)."""
    box, grid = config.partition.box(scene.centers[list(scene.train)]), config.grid
    labels = np.empty(len(means), np.int64)
    for start in range(0, len(means), _ROWS):  # which bounds what contraction needs
        rows = slice(start, start + _ROWS)
        labels[rows] = grid.block_of(contract(means[rows], box))
    return labels


def decide_plan(scene: Scene, means: NDArray[np.float32], scores: csr_array, config: RunConfig) -> Plan:
    """The partition (eqs. 7-11).

    Args: means (N, 3) of the scene Gaussians of Stage I; scores (K, B) of the training cameras, in order.
    """
    return make_plan(
        scene.centers[list(scene.train)],
        means,
        scores,
        config.grid,
        config.partition,
        rows=scene.train,
        names=[scene.panoramas[row].name for row in scene.train],
    )


def write_plan(folder: RunFolder, plan: Plan, scores: csr_array) -> None:
    """Writes scores.npz and plan.json. Args: scores (K, B) that the plan was made of."""
    folder.make(folder.plan.parent)
    write_scores(folder.scores, plan.rows, scores)
    write_json(folder.plan, plan.to_json())


def join_scores(shards: Iterable[tuple[Path, Sequence[int]]], blocks: int) -> csr_array:
    """(K, blocks) scores of all training cameras from the files of their shards, each with its cameras.

    Raises InputError if a file holds others.
    """
    return vstack([read_scores(path, cameras, blocks) for path, cameras in shards], format="csr")


def plan_records(
    folder: RunFolder,
    plan: Plan,
    scores: csr_array,
    passes: tuple[tuple[str, ...], ...] = (),
    measures: int = 0,
) -> list[Record]:
    """The records of a plan, and of the tasks that follow its blocks.

    Args: scores (K, B) that the plan was made of; passes, their tasks; measures, shards of the evaluation.
    """
    cameras = plan.assignment.counts.tolist()
    blocks = tuple(
        BlockPlan(block, seen, count, train=train)
        for block, (seen, count, train) in enumerate(
            zip(cameras, plan.gaussians.tolist(), plan.trained.tolist(), strict=True)
        )
    )
    notices = [Noticed(PLAN, line) for line in audit(plan, scores)]
    return [*notices, PlanSaved(folder.relative(folder.plan), blocks, passes, measures)]
