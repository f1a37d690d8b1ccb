"""The driver: a thin loop that starts what `policy` says and writes down what happens.

It is the single writer of the run folder, and all that it knows is in there: another can take over any time.
"""

import sqlite3
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NoReturn

from panolog.orchestrator.driver import job as stages
from panolog.orchestrator.driver.attempts import Attempt
from panolog.orchestrator.driver.demands import Requests, Sizes, spare
from panolog.orchestrator.driver.evaluation import Evaluation
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.driver.merging import copy_coarse, merge_run
from panolog.orchestrator.driver.partitioning import decide_plan, join_scores, plan_records, write_plan
from panolog.orchestrator.driver.saving import save
from panolog.orchestrator.driver.stopping import Stop
from panolog.orchestrator.resources import costs, placement
from panolog.orchestrator.resources.messages import Ended, Failed, Hello, Message
from panolog.orchestrator.resources.nodes import Node, Place
from panolog.orchestrator.resources.pool import Pool
from panolog.orchestrator.run import control, policy
from panolog.orchestrator.run.records import (
    INPUT,
    EvaluationSaved,
    Noticed,
    Record,
    RunBegan,
    RunEnded,
    StopRequested,
    Stored,
    TaskFailed,
    TaskYielded,
)
from panolog.orchestrator.run.state import DONE, RunState, apply, replay, score_task
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import InputError, PanologError, RunError
from panolog.workers.events import Progress

_WAIT = 0.5  # seconds after which the display is refreshed although nothing was said
_GRACE = 60.0  # seconds in which tasks that are asked to stop must have yielded their checkpoints

Show = Callable[[RunState, Sequence[Stored]], None]


class Driver:
    """Drives one job to its end. Needs the run folder's lock to be held."""

    def __init__(
        self, job: Job, database: Database, pool: Pool, show: Show, stop: Stop | None = None
    ) -> None:
        self._job = job
        self._database = database
        self._pool = pool
        self._show = show
        self._stop = stop or Stop()
        self._state = replay(database.milestones())
        self._shared = stages.Shared(job, pool.put, pool.share_files)
        self._attempts: dict[str, Attempt] = {}  # of the tasks that the pool has
        self._evaluation: Evaluation | None = None
        self._sizes = Sizes(job)
        self._nodes: tuple[Node, ...] = ()
        self._news = True  # something has happened since it was last decided what to start

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
            while (end := self._next()) is None:
                self._handle(self._pool.wait(_WAIT))
                self._listen()
                if self._stop.asked:
                    self._wind_down()
        except KeyboardInterrupt:
            self._record([RunEnded("interrupted")])
            raise
        except PanologError as error:
            self._record([RunEnded("failed", str(error))])
            raise
        return end

    def _listen(self) -> None:
        """Does what people have asked for through the run folder."""
        for said in control.take(self._job.folder):
            if isinstance(said, Noticed):
                self._record([said])
            elif said.action == control.STOP:
                self._stop.asked = True
            else:
                self._record([policy.answer(self._state, said)])
                self._news = True
        for name, attempt in self._attempts.items():
            if attempt.greeted and not attempt.asked and self._state.task(name).held:
                self._ask_to_yield(name)

    def _ask_to_yield(self, name: str) -> None:
        """Asks a task for a last checkpoint and its end."""
        self._attempts[name].asked = True
        self._pool.stop(name)

    def _remove_outdated_checkpoints(self) -> None:
        """Those of tasks whose driver was killed between the record of the result and its clearing up."""
        for task in self._state.tasks.values():
            if task.status == DONE:
                self._job.folder.checkpoint(task.name).unlink(missing_ok=True)

    def _next(self) -> tuple[str, str] | None:
        """Starts what can start, if anything has happened. Returns how the run has ended, if it has."""
        nodes = self._pool.nodes()
        shards, refine = len(self._job.shards), self._job.config.refine
        while self._news or nodes != self._nodes:
            self._nodes, self._news = nodes, False
            if (end := policy.outcome(self._state, shards=shards, refine=refine)) is not None:
                return end
            self._start_ready(policy.ready(self._state, shards=shards, refine=refine))
        return None

    def _start_ready(self, ready: Sequence[str]) -> None:
        names = [name for name in ready if name not in self._attempts]
        if names == ["plan"]:
            with self._stop.at_once():
                records = self._make_plan()
        elif names == ["merge"]:
            with self._stop.at_once():
                records = [self._merge()]
        else:
            self._place(names)
            return
        self._news = True
        self._record(records)

    def _place(self, names: Sequence[str]) -> None:
        """Starts those of the tasks for which there is a place now."""
        model = costs.fit(costs.samples_of(self._state))
        requests = Requests(self._sizes, self._state, model)
        places = {name: attempt.place for name, attempt in self._attempts.items()}
        running = requests.running(places, time.time())
        cuda = self._job.config.device == "cuda"
        for name, place in placement.place(requests.of(names), self._nodes, running, cuda=cuda):
            self._start(name, place)

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

    def _start(self, name: str, place: Place) -> None:
        task = self._state.task(name)
        work, fields, iteration = stages.prepare(self._job, self._shared, name)
        fields = spare(fields, task.shortages)
        if name == "eval":
            self._evaluation = stages.new_evaluation(self._job)
        self._attempts[name] = Attempt(name, task.attempts + 1, iteration, place, fields.get("config"))
        self._pool.start(name, place, work, fields)

    def _wind_down(self) -> NoReturn:
        """Asks all that train for a last checkpoint, and waits for these, but not for ever."""
        training = [name for name, a in self._attempts.items() if a.greeted and policy.trains(name)]
        self._record([StopRequested(len(training))])
        for name in training:
            self._ask_to_yield(name)
        last = time.monotonic() + _GRACE
        while not self._attempts.keys().isdisjoint(training) and time.monotonic() < last:
            self._handle(self._pool.wait(_WAIT))
        raise KeyboardInterrupt

    def _handle(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Saves what the messages carry, at most one of each task, then records all of it at once."""
        records: list[Record] = []
        wrong: InputError | None = None
        for name, message in messages:
            if isinstance(message, Hello):
                records.append(self._attempts[name].started(message, self._job.config.device))
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
        self._news = self._news or any(not isinstance(message, Progress) for _, message in messages)
        self._record(records)
        if wrong is not None:
            raise wrong

    def _ended(self, name: str) -> list[Record]:
        """What follows from the end of a task. One that ended without its result has failed, or was asked."""
        if name == "eval" and self._evaluation is not None:
            del self._attempts[name]
            folder = self._job.folder
            metrics = self._evaluation.save(folder)
            return [EvaluationSaved(folder.relative(folder.metrics), metrics)]
        done, records = self._state.status(name) == DONE, list[Record]()
        if done:
            self._job.folder.checkpoint(name).unlink(missing_ok=True)
        elif self._attempts[name].asked:
            records = [TaskYielded(name)]
        elif not self._stop.asked:
            return [self._failed(name, Failed("the worker ended without a result"))]
        del self._attempts[name]
        return records

    def _failed(self, name: str, message: Failed) -> TaskFailed:
        attempt = self._attempts.pop(name)
        memory, kind = attempt.place.memory, message.kind
        largest = placement.largest(self._nodes, cuda=self._job.config.device == "cuda")
        retries = self._job.config.retries
        verdict = policy.after_failure(
            self._state.task(name), kind, retries=retries, memory=memory, largest=largest
        )
        return TaskFailed(
            name, attempt.number, message.reason, verdict.final, message.detail, kind, memory, verdict.then
        )

    def _record(self, records: Sequence[Record]) -> None:
        stored = self._database.append(records) if records else []
        for item in stored:
            self._state = apply(self._state, item)
        self._show(self._state, stored)
