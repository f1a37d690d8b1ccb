"""The driver: a thin loop that starts what `policy` says and writes down what happens.

It is the single writer of the run folder, and all that it knows is in there: another can take over any time.
"""

import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from panolog.orchestrator import policy, stages
from panolog.orchestrator.database import Database
from panolog.orchestrator.evaluation import Evaluation
from panolog.orchestrator.merging import copy_coarse, merge_run
from panolog.orchestrator.messages import INPUT, Ended, Failed, Hello, Message
from panolog.orchestrator.partitioning import decide_plan, join_scores, plan_records, write_plan
from panolog.orchestrator.preflight import BLOCK_GROWTH, decoded_bytes, estimate_scene, fitting, task_memory
from panolog.orchestrator.records import (
    EvaluationSaved,
    Record,
    RunBegan,
    RunEnded,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.saving import save
from panolog.orchestrator.stages import Job
from panolog.orchestrator.state import DONE, RunState, apply, replay, score_task
from panolog.scene.errors import InputError, PanologError, RunError
from panolog.scene.files import Locate
from panolog.workers.events import Event

_WAIT = 0.5  # seconds after which the display is refreshed although nothing was said

Show = Callable[[RunState, Sequence[Stored]], None]
Work = Callable[..., Iterator[Event]]


class Pool(Protocol):
    """Where tasks run: `ray_pool.RayPool`."""

    machine: policy.Machine

    def put(self, value: object) -> Any:
        """Shares a value with all tasks."""

    def share_files(self, root: Path, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        """How a task finds files of the scene, and files that the run in the folder `root` has made."""

    def start(self, name: str, share: policy.Share, work: Work, fields: dict[str, Any]) -> None:
        """Runs `work(**fields)` when its share is free."""

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
        """Messages of running tasks."""


@dataclass
class _Attempt:
    number: int  # 1 for the first
    iteration: int  # it goes on from here
    threads: int


class Driver:
    """Drives one job to its end. Needs the run folder's lock to be held."""

    def __init__(self, job: Job, database: Database, pool: Pool, show: Show) -> None:
        self._job = job
        self._database = database
        self._pool = pool
        self._show = show
        self._state = replay(database.milestones())
        self._shared = stages.Shared(job, pool.put, pool.share_files)
        self._attempts: dict[str, _Attempt] = {}  # of the tasks that the pool has
        self._evaluation: Evaluation | None = None

    def run(self, began: RunBegan) -> RunState:
        """Goes on until the run has ended.

        Raises InputError if a worker found the input wrong, RunError if the run failed. Either is recorded,
        as is an interruption; so is a full disk, if it still takes that.
        """
        try:
            self._record([began])
            self._remove_outdated_checkpoints()
            outcome, reason = self._to_the_end()
            self._record([RunEnded(outcome, reason)])
        except (OSError, sqlite3.Error) as error:
            with suppress(OSError, sqlite3.Error):
                self._record([RunEnded("failed", str(error))])
            root = self._job.folder.root
            raise RunError(f"{root}: {error}; mend that, then `panolog resume {root}` goes on") from error
        if outcome == "failed":
            raise RunError(reason)
        return self._state

    def _to_the_end(self) -> tuple[str, str]:
        """The loop. Returns how the run ended and why; records any other end before it raises."""
        try:
            while (end := self._outcome()) is None:
                self._start_ready()
                self._handle(self._pool.wait(_WAIT))
        except KeyboardInterrupt:
            self._record([RunEnded("interrupted")])
            raise
        except PanologError as error:
            self._record([RunEnded("failed", str(error))])
            raise
        return end

    def _remove_outdated_checkpoints(self) -> None:
        """Those of tasks whose driver was killed between the record of the result and its clearing up."""
        for task in self._state.tasks.values():
            if task.status == DONE:
                self._job.folder.checkpoint(task.name).unlink(missing_ok=True)

    def _outcome(self) -> tuple[str, str] | None:
        return policy.outcome(self._state, shards=len(self._job.shards), refine=self._job.config.refine)

    def _ready(self) -> tuple[str, ...]:
        return policy.ready(self._state, shards=len(self._job.shards), refine=self._job.config.refine)

    def _start_ready(self) -> None:
        names = [name for name in self._ready() if name not in self._attempts]
        if names == ["plan"]:
            self._record(self._make_plan())
        elif names == ["merge"]:
            self._record([self._merge()])
        elif names:
            together = len(names) + len(self._attempts)
            device = self._job.config.device
            share = policy.share(together, self._pool.machine, device=device, fit=self._fit())
            for name in names:
                self._start(name, share)

    def _make_plan(self) -> list[Record]:
        job, coarse = self._job, self._shared.coarse
        shards = [job.folder.shard(score_task(shard)) for shard in range(len(job.shards))]
        plan = decide_plan(job.scene, coarse, join_scores(shards, job.scene.train), job.config)
        write_plan(job.folder, plan, coarse)
        return plan_records(job.folder, plan)

    def _merge(self) -> Record:
        folder = self._job.folder
        if not self._job.config.refine:
            return copy_coarse(folder)
        return merge_run(folder, self._state, self._shared.plan)

    def _fit(self) -> int:
        """How many tasks memory holds."""
        machine, job = self._pool.machine, self._job
        if machine.memory is None:
            return machine.cpus
        task = estimate_scene(job.scene, job.config).task
        if self._state.status("coarse") == DONE:  # what Stage I came to is known; blocks grow from there
            gaussians = BLOCK_GROWTH * len(self._shared.coarse)
            task = task_memory(gaussians, decoded_bytes(job.scene, job.width), job.width, job.config)
        return fitting(task, machine.memory)

    def _start(self, name: str, share: policy.Share) -> None:
        work, fields, iteration = stages.prepare(self._job, self._shared, name)
        if name == "eval":
            self._evaluation = stages.new_evaluation(self._job)
        number = self._state.task(name).attempts + 1
        self._attempts[name] = _Attempt(number, iteration, share.cpus)
        self._pool.start(name, share, work, fields)

    def _handle(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Saves what the messages carry, at most one of each task, then records all of it at once."""
        records: list[Record] = []
        wrong: InputError | None = None
        for name, message in messages:
            if isinstance(message, Hello):
                records.append(self._started(name, message))
            elif isinstance(message, Ended) or (
                isinstance(message, Failed) and self._state.status(name) == DONE
            ):  # a worker that dies after its result has been saved has done its work
                records += self._ended(name)
            elif isinstance(message, Failed):
                records.append(self._failed(name, message))
                wrong = InputError(message.reason) if message.kind == INPUT else wrong
            else:
                if name == "eval" and self._evaluation is not None:
                    self._evaluation.add(message)
                records.append(save(self._job.folder, message))
        self._record(records)
        if wrong is not None:
            raise wrong

    def _started(self, name: str, hello: Hello) -> TaskStarted:
        attempt, device = self._attempts[name], self._job.config.device
        return TaskStarted(
            name, attempt.number, attempt.iteration, hello.node, hello.pid, device, attempt.threads
        )

    def _ended(self, name: str) -> list[Record]:
        """What follows from the end of a task. One that ended without its result has failed."""
        if name == "eval" and self._evaluation is not None:
            del self._attempts[name]
            folder = self._job.folder
            metrics = self._evaluation.save(folder)
            return [EvaluationSaved(folder.relative(folder.metrics), metrics)]
        if self._state.status(name) != DONE:
            return [self._failed(name, Failed("the worker ended without a result"))]
        del self._attempts[name]
        self._job.folder.checkpoint(name).unlink(missing_ok=True)
        return []

    def _failed(self, name: str, message: Failed) -> TaskFailed:
        number = self._attempts.pop(name).number
        again = policy.may_retry(number, self._job.config.retries, user_error=message.kind == INPUT)
        return TaskFailed(name, number, message.reason, final=not again, detail=message.detail)

    def _record(self, records: Sequence[Record]) -> None:
        stored = self._database.append(records) if records else []
        for item in stored:
            self._state = apply(self._state, item)
        self._show(self._state, stored)
