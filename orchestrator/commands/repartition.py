"""`panolog partition`: the plan of a run again with other parameters, without training anything."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.driver.job import scene_of
from panolog.orchestrator.driver.partitioning import block_labels, decide_plan, write_plan
from panolog.orchestrator.resources.basis import basis_of
from panolog.orchestrator.resources.machine import cores, memory
from panolog.orchestrator.resources.nodes import Node
from panolog.orchestrator.resources.preflight import estimator_of
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.partition.plan import Plan, read_plan
from panolog.scene.errors import InputError
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply
from panolog.workers.events import Progress, Scored
from panolog.workers.scoring import ScoreTask, score

Change = Callable[[RunConfig], RunConfig]
Hear = Callable[[Progress], None]


def plan_again(root: Path, change: Change, output: Path | None, *, device: str, hear: Hear) -> Plan:
    """The plan of the run in `root` under changed settings; the run folder stays as it is.

    Scores depend on the cells (eq. 10), so other blocks or another ρ_tri cost one pass over the training
    views; another τ_grad alone costs nothing.

    Args: change makes the settings; output, where to write the plan's files, None = nowhere; hear is told of
    the progress of scoring. Raises InputError if the run has no Stage I model yet, its scene has changed,
    `output` is a run or a setting is wrong.
    """
    folder = RunFolder(root)
    info = read_info(folder)
    config = change(info.config)
    if output is not None and RunFolder(output).info.exists():
        raise InputError(f"{output}: is a run, with a plan of its own; a what-if goes into another folder")
    if not folder.model("coarse").exists():
        raise InputError(f"{root}: Stage I has not ended, and there is nothing to partition before")
    scene = scene_of(info)
    here = Node("", "", cores(), memory())
    config = estimator_of(scene, config, basis_of(folder, scene, config), (here,)).config  # blocks: auto
    coarse = read_ply(folder.model("coarse"))
    scores = _scores_of(folder, config)
    if scores is None:
        scores = _score(scene, coarse, config, device, hear)
    plan = decide_plan(scene, coarse, scores, config)
    if output is not None:
        write_plan(RunFolder(output), plan, coarse)
    return plan


def _scores_of(folder: RunFolder, config: RunConfig) -> NDArray[np.float64] | None:
    """(K, B) scores of the run itself, if it has them for the same cells."""
    if not folder.plan.exists():
        return None
    plan = read_plan(folder.plan)
    same = plan.grid == config.grid and plan.config.rho_tri == config.partition.rho_tri
    return plan.scores if same else None


def _score(
    scene: Scene, coarse: Gaussians, config: RunConfig, device: str, hear: Hear
) -> NDArray[np.float64]:
    task = ScoreTask(
        name="score/000",
        scene=scene,
        views=scene.train,
        width=config.width or scene.width,
        gaussians=coarse,
        labels=block_labels(scene, coarse, config),
        blocks=config.grid.count,
        config=config,
        device=device,
    )
    for event in score(task):
        if isinstance(event, Progress):
            hear(event)
        if isinstance(event, Scored):
            scores: NDArray[np.float64] = event.scores.numpy()
    return scores
