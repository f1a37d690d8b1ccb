"""`panolog partition`: the plan of a run with other parameters, without training."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from panolog.orchestrator.engine.driver.job import Job, Specs
from panolog.orchestrator.engine.estimates.calibration import basis_of
from panolog.orchestrator.engine.estimates.costs import StageEstimate
from panolog.orchestrator.engine.estimates.preflight import estimator_of, stage_line
from panolog.orchestrator.engine.scheduling.pool import InProcess
from panolog.orchestrator.engine.stages.partitioning import decide_plan, write_plan
from panolog.orchestrator.engine.stages.scenes import learnt_scene, scene_of
from panolog.orchestrator.runs.config import RunConfig, change
from panolog.orchestrator.runs.folder import RunFolder, make
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.runs.machines.machine import cores, memory
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.watch.views.plan_picture import write_plan_picture
from panolog.partition.audit import audit
from panolog.partition.plan import Plan, read_plan
from panolog.partition.scores import read_scores
from panolog.renderer.process import choose_device
from panolog.scene.errors import InputError
from panolog.scene.ply import ply_header, read_scene_means
from panolog.scene.write import StageProgress
from panolog.workers.events import Scored
from panolog.workers.tasks import COARSE, Progress, TaskId


@dataclass(frozen=True, eq=False)
class WhatIf:
    """A plan that was tried, what its Stage II would need on this machine, and the folder of its files."""

    plan: Plan
    audit: tuple[str, ...]  # what there is to say about it
    blocks: Mapping[int, StageEstimate]  # those that are trained
    needs: StageEstimate | None  # of all of them; None if no block is trained
    written: Path | None

    def lines(self) -> Iterator[str]:
        """The lines that people read."""
        for block in self.plan.to_json()["blocks"]:
            has = f"{len(block['cameras'])} cameras, {block['gaussians']:,} Gaussians"
            needs = self.blocks.get(block["block"])
            yield f"block {block['block']}: {has}; {stage_line(needs) if needs else 'not trained'}"
        yield from self.audit
        yield f"Stage II on this machine: {stage_line(self.needs) if self.needs else 'no block is trained'}"
        yield f"written to {self.written}" if self.written else "not written; give --output FOLDER to keep it"


def repartition(
    root: Path,
    changes: Mapping[str, Any],
    output: Path | None,
    *,
    device: str | None,
    progress: StageProgress,
) -> WhatIf:
    """The plan of the run in `root` under changed settings; the run folder stays as it is.

    Scores depend on the cells (eq. 10), so other blocks or another ρ_tri cost one pass over the training
    views; another τ_grad alone costs nothing.

    Args: changes, settings by dotted key, None = as in the run; output, where to write the plan's files,
    None = nowhere; device, as `choose_device`.
    Raises InputError if the run has no Stage I model yet, its scene has changed, `output` is a run or a
    setting is wrong.
    """
    device, folder = choose_device(device), RunFolder(root)
    info = read_info(folder)
    config = change(info.config, changes)
    if changes.get("blocks") or changes.get("partition.rho_tri") is not None:
        config = change(config, {"partition.cuts": ()})  # balanced blocks are cut anew
    if output is not None and RunFolder(output).info.exists():
        raise InputError(f"{output}: is a run, which has its own plan; choose another folder")
    if not folder.model(COARSE).exists():
        raise InputError(f"{root}: Stage I has not ended, so there is nothing to partition yet")
    scene = learnt_scene(folder, scene_of(info, folder))
    here = Node("", "", cores(), memory())
    estimator = estimator_of(scene, config, basis_of(folder, scene, config), (here,))
    config = estimator.config  # its blocks chosen
    means, count = read_scene_means(folder.model(COARSE)), ply_header(folder.model(COARSE))[0]
    scores = _scores_of(folder, config)
    if scores is None:
        scores = _score(Job(folder, scene, config.model_copy(update={"device": device})), progress)
    plan = decide_plan(scene, means, scores, config)
    if output is not None:
        other = RunFolder(output)
        make(output)
        write_plan(other, plan, scores)
        write_plan_picture(other.plan_picture, plan, means)
    cameras, own = plan.assignment.counts, plan.gaussians
    blocks = {
        int(b): estimator.block(count, int(own[b]), int(cameras[b])) for b in np.flatnonzero(plan.trained)
    }
    most = int(cameras[plan.trained].max(initial=0))
    needs = estimator.refinement(count, len(blocks), most) if blocks else None
    return WhatIf(plan, tuple(audit(plan, scores)), blocks, needs, output and RunFolder(output).plan.parent)


def _scores_of(folder: RunFolder, config: RunConfig) -> csr_array | None:
    """(K, B) scores of the run itself, if it has them for the same cells."""
    if not folder.plan.exists():
        return None
    plan = read_plan(folder.plan)
    box = config.partition.box(plan.centers)  # an older run may have bounded its own otherwise
    same = plan.grid == config.grid and np.array_equal(plan.aabb.half, box.half)
    return read_scores(folder.scores, plan.rows, plan.grid.count) if same else None


def _score(job: Job, progress: StageProgress) -> csr_array:
    for event in Specs(job, InProcess()).score(TaskId.shard(0), job.scene.train).run():
        if isinstance(event, Progress):
            progress("score", event.iteration, event.iterations)
        if isinstance(event, Scored):
            scores = csr_array(event.scores.numpy())
    return scores
