"""Results that the driver makes itself, between those of workers."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.engine.driver.job import Job, Specs, new_evaluation
from panolog.orchestrator.engine.driver.saving import remove_checkpoints
from panolog.orchestrator.engine.scheduling.pool import Sharing
from panolog.orchestrator.engine.stages.evaluation import Evaluation
from panolog.orchestrator.engine.stages.merging import (
    Early,
    copy_coarse,
    join_districts,
    merge_run,
    merge_unfinished,
    unite_blocks,
)
from panolog.orchestrator.engine.stages.partitioning import decide_plan, join_scores, plan_records, write_plan
from panolog.orchestrator.runs.records import EvaluationSaved, Noticed, Record
from panolog.orchestrator.runs.state import RunState, Status
from panolog.partition.cells import Volume
from panolog.partition.plan import Plan
from panolog.workers.tasks import COARSE, EVAL, Stage, TaskId

OnPlan = Callable[[Plan, NDArray[np.float32]], None]
Deliver = Callable[[Job], list[Record]]


class Results:
    def __init__(self, job: Job, pool: Sharing, on_plan: OnPlan, deliver: Deliver) -> None:
        """Args: on_plan is called with the plan and (N, 3) means of Stage I before plan.json is written;
        deliver makes the files for viewers and returns their records.
        """
        self._job = job
        self._pool = pool
        self._on_plan = on_plan
        self._deliver = deliver

    @cached_property
    def specs(self) -> Specs:
        """The specs of the stages after Stage I."""
        return Specs(self._job.learnt, self._pool)

    def maker(self, task: TaskId, state: RunState) -> Callable[[], list[Record]] | None:
        """What makes the result of a task and returns its records; None for a task of workers.

        It raises OSError if the disk takes no file.
        """
        job, districts = self._job, self._job.districts
        match task.stage:
            case Stage.COARSE if districts is not None:
                return lambda: [join_districts(job.folder, job.scene, districts, job.config.iterations)]
            case Stage.PLAN:
                return self._plan
            case Stage.UNION:
                return lambda: self._unite(task, state)
            case Stage.MERGE:
                return lambda: self._merge(state)
            case Stage.EVAL if state.measures:
                return lambda: self._join(state)
            case Stage.DELIVER:
                return lambda: self._deliver(self.specs.job)
        return None

    def measured(self, task: TaskId, evaluation: Evaluation) -> Record:
        """Keeps what the evaluation, or a shard of it, has measured, and returns the record of it.

        Raises OSError if the disk takes no file.
        """
        folder = self._job.folder
        if task == EVAL:
            return EvaluationSaved(folder.relative(folder.metrics), evaluation.save(folder))
        record = evaluation.save_shard(folder, task)
        remove_checkpoints(folder, task)
        return record

    def _plan(self) -> list[Record]:
        job, means = self.specs.job, self.specs.means
        shards = ((job.folder.shard(TaskId.shard(i)), cameras) for i, cameras in enumerate(job.shards))
        scores = join_scores(shards, job.config.grid.count)
        plan = decide_plan(job.scene, means, scores, job.config)
        self._on_plan(plan, means)
        write_plan(job.folder, plan, scores)
        return plan_records(job.folder, plan, scores, self.specs.passes(), len(self.specs.measures))

    def _unite(self, task: TaskId, state: RunState) -> list[Record]:
        folder = self._job.folder
        for later in state.following(task)[0]:  # what it has of an earlier union
            remove_checkpoints(folder, later)
        return [unite_blocks(folder, state, self.specs.plan, task)]

    def _merge(self, state: RunState) -> list[Record]:
        job, folder = self._job, self._job.folder
        if state.status(COARSE) != Status.DONE:
            parts: list[tuple[TaskId, Volume | None]] = [(COARSE, None)]
            if (districts := job.districts) is not None:
                parts = [(TaskId.district(i), districts.cell(i)) for i in range(districts.count)]
            return merge_unfinished(folder, state, job.scene, parts)
        if not job.config.refine or state.plan is None:
            return [copy_coarse(folder)]
        early = None
        if state.money.reached is not None:
            early = Early(job.scene, job.config.densify.prune_opacity, job.config.iterations)
        return [merge_run(folder, state, self.specs.plan, self.specs.repaired, early)]

    def _join(self, state: RunState) -> list[Record]:
        job, faces = self._job, len(self.specs.faces)
        evaluation = new_evaluation(job, faces, detail=job.config.measured_detail)
        evaluation.join(job.folder, state.measures)
        reason = evaluation.lpips_reason
        notices: list[Record] = [Noticed(EVAL, reason)] if reason else []
        return [*notices, self.measured(EVAL, evaluation)]
