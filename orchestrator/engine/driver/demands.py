"""What each task demands of a machine: from the scene, the plan and what the run has measured so far."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property

from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.estimates.calibration import basis_of
from panolog.orchestrator.engine.estimates.costs import (
    Estimate,
    block_times,
    fit,
    in_all,
    predictor,
    seconds_left,
    slowness,
)
from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.engine.scheduling.placement import USABLE, Demand, Running
from panolog.orchestrator.engine.scheduling.scaling import Work
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.records import BlockPlan, Failure
from panolog.orchestrator.runs.state import RunState, Status
from panolog.scene.ply import ply_header
from panolog.workers.tasks import COARSE, Stage, TaskId
from panolog.workers.training.task_config import CacheConfig

_SMALLER = 1 / 4  # of the image cache, after a shortage of memory
_FREE = 1 / 2  # of a machine's free memory that its tasks on GPUs fill with decoded panoramas
_SOME = ""  # a kind of place of which nothing is known: the average one
_DIGITS = 6  # of the binary number of a block's Gaussians: its memory is known within 3 %
_OF_LOST = 0.2  # of an error: whatever ends a process says little about its node


class Demands:
    """Makes the demands of tasks at one moment of a run."""

    def __init__(self, sizes: "Sizes", state: RunState) -> None:
        self._sizes = sizes
        self._state = state
        self._samples = block_times(state)
        self._model = fit(self._samples)

    def of(self, tasks: Iterable[TaskId]) -> list[Demand]:
        """The demands of tasks that wait."""
        return [self._demand(task) for task in tasks]

    def work(self, tasks: Sequence[TaskId]) -> Work:
        """What of a stage waits, with how long each task and the whole stage are expected to take."""
        demands, stage = self.of(tasks), tasks[0].stage if tasks else Stage.MERGE
        each = [demand.seconds(_SOME) for demand in demands]
        blocks = [(b.cameras, b.gaussians) for b in self._state.plan or () if b.train]
        if stage is Stage.BLOCK and self._samples:
            return Work(demands, each, in_all(self._samples, blocks))
        expected = self._sizes.expected(stage, self._state) if tasks else None
        if expected is None:
            return Work(demands, each)
        seconds, count = expected
        if stage in (Stage.BLOCK, Stage.ROUND):
            relative = sum(predictor(self._model, *block)(_SOME) for block in blocks)
        else:
            relative = float(count)
        return Work(demands, [one * seconds / relative for one in each], seconds)

    def running(self, placements: Mapping[TaskId, Placement], now: float) -> list[Running]:
        """Where tasks run, and for how long they still do. Args: now, seconds since the epoch."""
        return [Running(where, self._left(task, where, now)) for task, where in placements.items()]

    def _demand(self, task: TaskId) -> Demand:
        memory, seconds = self._sizes.of(task, self._state), self._seconds(task)
        if (state := self._state.tasks.get(task)) is None:
            return Demand(task, memory, seconds)
        more_than = state.starved if state.shortages > 1 else 0
        avoid = defaultdict[str, float](float)
        for failure in state.failures:
            for where in filter(None, failure.where):
                avoid[where] += _OF_LOST if failure.kind == Failure.LOST else 1
        alone = state.shortages > 0
        return Demand(task, memory, seconds, alone=alone, more_than=more_than, avoid=avoid)

    def _seconds(self, task: TaskId) -> Callable[[str], float]:
        if task.stage not in (Stage.BLOCK, Stage.ROUND):
            return lambda _: 1.0
        block = self._sizes.plan(self._state)[task.number]
        return predictor(self._model, block.cameras, block.gaussians)

    def _left(self, task: TaskId, where: Placement, now: float) -> float:
        state = self._state.task(task)
        if state.status == Status.DONE:  # its result is saved, and its process ends
            return 0.0
        return seconds_left(state, self._seconds(task)(where.kind), now - (state.since or now))


class Sizes:
    """Bytes that tasks need, roughly: of a GPU, or of a node for a job on the CPU."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._plan: dict[int, BlockPlan] = {}
        self._blocks: dict[int, int] = {}
        self._shards: dict[int, int] = {}

    def of(self, task: TaskId, state: RunState) -> int:
        """The Gaussians of one task. Args: state of the run, which has the plan when blocks are trained."""
        match task.stage:
            case Stage.BLOCK | Stage.ROUND:
                return self._of_blocks(state)[task.number]
            case Stage.DISTRICT | Stage.COARSE:
                stage = self._estimate.stages[0]
                return stage.device or stage.host
            case Stage.REPAIR:  # part of two blocks, on panoramas of both
                return max(self._of_blocks(state).values())
            case Stage.SCORE if self._job.config.stage2.reduces:
                return self._scored
            case Stage.MEASURE if state.merged is not None:
                return self._measured(state.merged.gaussians)
            case _:
                return self._rendering

    @cached_property
    def _estimator(self) -> Estimator:
        job = self._job
        return Estimator(job.scene, job.config, basis_of(job.folder, job.scene, job.config), ())

    def expected(self, stage: Stage, state: RunState) -> tuple[float, int] | None:
        """Seconds of all tasks of a stage, one after another, and how many these are; None if not known."""
        for found in self._estimate.stages:
            if found.name is stage and found.seconds:
                return found.seconds * slowness(state), found.tasks
        return None

    @cached_property
    def _estimate(self) -> Estimate:
        return self._estimator.estimate()

    def plan(self, state: RunState) -> Mapping[int, BlockPlan]:
        """The blocks by number; a run has one plan."""
        self._plan = self._plan or {block.block: block for block in state.plan or ()}
        return self._plan

    def _of_blocks(self, state: RunState) -> Mapping[int, int]:
        if not self._blocks:
            self._blocks = {plan.block: self._block(plan) for plan in state.plan or ()}
        return self._blocks

    def _block(self, plan: BlockPlan) -> int:
        step = 1 << max(0, plan.gaussians.bit_length() - _DIGITS)  # rounded up: of thousands, few differ
        stage = self._estimator.block(self._gaussians, -(-plan.gaussians // step) * step, plan.cameras)
        return stage.device or stage.host

    @cached_property
    def _scored(self) -> int:
        host, device = self._estimator.scored(self._gaussians)[1]
        return device or host

    def _measured(self, merged: int) -> int:
        if merged not in self._shards:
            host, device = self._estimator.measured(merged)[1]
            self._shards[merged] = device or host
        return self._shards[merged]

    @cached_property
    def _rendering(self) -> int:
        estimator, work = self._estimator, (self._gaussians, len(self._job.scene.train))
        needs = [estimator.rendering(*work), estimator.scoring(*work)]
        return max(device or host for host, device in needs)

    @cached_property
    def _gaussians(self) -> int:
        """What Stage I came to; where a limit has ended it, what was made of it."""
        model = self._job.folder.model(COARSE)
        return ply_header(model if model.exists() else self._job.folder.point_cloud)[0]


def image_cache(cache: CacheConfig, where: Placement, node: Node, need: int, shortages: int) -> CacheConfig:
    """The image cache of a task at its place: on a GPU, what the settings leave open follows free memory.

    Args: need, bytes of the GPU that the task needs besides; shortages of memory that it has had.
    """
    memory, device = cache.memory, cache.device
    if shortages:
        memory, device = memory * _SMALLER, 0.0
    elif where.gpu is not None:
        if memory == CacheConfig().memory:
            memory = max(memory, _FREE * node.memory * where.cpus / max(1, node.cpus) / 2**30)
        if device is None:
            device = max(0.0, USABLE * where.memory - need) / 2**30
    return cache.model_copy(update={"memory": memory, "device": device})
