"""The driver: a loop that starts the tasks that `policy` allows and records what happens.

It is the only writer of the run folder, and all of its state is there: another driver can take over any time.
"""

import logging
import math
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from socket import gethostname

from panolog.orchestrator.engine.driver.attempts import Attempt, WorkerSpec
from panolog.orchestrator.engine.driver.deadlines import Deadlines
from panolog.orchestrator.engine.driver.demands import Demands, Sizes, image_cache
from panolog.orchestrator.engine.driver.ending import end_recorded
from panolog.orchestrator.engine.driver.job import Job, Specs, new_evaluation
from panolog.orchestrator.engine.driver.journal import Journal, Patience
from panolog.orchestrator.engine.driver.machines import Machines
from panolog.orchestrator.engine.driver.own_results import Deliver, OnPlan, Results
from panolog.orchestrator.engine.driver.policy import outcome
from panolog.orchestrator.engine.driver.purse import Purse
from panolog.orchestrator.engine.driver.requests import Requests, Stop
from panolog.orchestrator.engine.driver.saving import Usages, make_outbox, remove_checkpoints, save, tidy
from panolog.orchestrator.engine.driver.writers import Writers
from panolog.orchestrator.engine.scheduling import quarantine
from panolog.orchestrator.engine.scheduling.large_messages import Large, payload
from panolog.orchestrator.engine.scheduling.placement import Placed
from panolog.orchestrator.engine.scheduling.pool import Ended, Failed, Hello, Pool
from panolog.orchestrator.engine.stages.evaluation import Evaluation
from panolog.orchestrator.runs.folder import command_line
from panolog.orchestrator.runs.machines.history import leaves_for_sure
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.machines.usage import Usage
from panolog.orchestrator.runs.money.records import BudgetReached
from panolog.orchestrator.runs.presence import Presence
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Delivered,
    Failure,
    ModelSaved,
    Outcome,
    Record,
    RunEnded,
    StopRequested,
    TaskFailed,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState, Status, ignore
from panolog.orchestrator.runs.units import gib
from panolog.scene.errors import ClusterLostError, InputError, RunError
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import (
    Calibration,
    Checkpoint,
    CheckpointWritten,
    Event,
    LpipsMissing,
    Scored,
    Trained,
)
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import Stage, TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.trainer import TrainSpec

_WAIT_S = 0.5  # after which the display is refreshed without a message
_TURN_S = 0.05  # the same while something large is written
_STARTS_S = 0.5  # of a turn in which tasks are started: what blocks begin with may take minutes to cut
_REVIEW_S = 60.0  # after which it is decided anew whether a task waits for another node than where it failed
_LOOK_S = 10.0  # the same while machines are on their way
_ENDS = (Trained, Scored, Ended, Failed)  # after these messages another task may start


@dataclass(frozen=True)
class Hooks:
    """What a driver calls as a run proceeds."""

    on_plan: OnPlan = ignore  # (N, 3) means of Stage I; before plan.json
    deliver: Deliver = lambda _: [Delivered("", 0, 0.0)]  # makes the files for viewers
    on_start: Callable[[WorkerSpec], TaskSpec] = lambda spec: spec  # returns the spec to start; for tests


_LOG = logging.getLogger(__name__)


class Driver:
    """Drives one job to its end. The caller holds the run folder's lock."""

    def __init__(
        self,
        job: Job,
        journal: Journal,
        pool: Pool,
        hooks: Hooks | None = None,
        stop: Stop | None = None,
    ) -> None:
        self._job = job
        self._journal = journal
        self._pool = pool
        self._clock = clock = journal.clock
        self._hooks = hooks or Hooks()
        self._stop = stop or Stop()
        self._specs = Specs(job, pool)
        self._results = Results(job, pool, self._hooks.on_plan, self._hooks.deliver)
        self._attempts: dict[TaskId, Attempt] = {}  # of the tasks that the pool has
        self._deadlines = Deadlines(job, clock)
        self._evaluations: dict[TaskId, Evaluation] = {}  # that are measured now
        self._sizes = Sizes(job)
        self._presence = Presence(job.folder.presence)
        self._requests = Requests(job.folder, journal, self._stop)
        root, retry = job.folder.root, job.config.disk.retry
        journal.patience = Patience(root, retry, self._presence, self._while_it_waits)
        self._writers = Writers(self._save, journal, clock)
        self._machines = Machines(pool, journal, job, clock)
        self._purse = Purse(journal, clock)
        self._nodes: tuple[Node, ...] = ()
        self._usages = Usages(job.folder, journal.database, clock)
        self._wrong: InputError | None = None  # what a worker has found
        self._placed: list[Placed] = []  # that start next, unless something happens before
        self._news = True  # something has happened since it was last decided what to start
        self._again = math.inf  # Clock.monotonic() at which to decide that without news

    @property
    def _state(self) -> RunState:
        return self._journal.state

    def run(self) -> RunState:
        """Runs until the run has ended, which the caller has begun.

        Raises InputError if a worker found the input wrong, unless for a block, RunError if the run failed.
        Any end is recorded, also by another error; that by a full disk, if it still takes that.
        """
        resume = command_line("resume", root := self._job.folder.root)
        try:
            with end_recorded(self._journal):
                self._journal.record(self._journal.until_done(lambda: tidy(self._job.folder, self._state)))
                outcome, reason = self._to_the_end()
                self._journal.record([RunEnded(outcome, reason)])
        except (OSError, sqlite3.Error) as error:
            raise RunError(f"{root}: {error}; fix that, then resume with `{resume}`") from error
        except ClusterLostError as error:
            raise ClusterLostError(f"{error}; `{resume}` continues the run") from error
        if outcome == Outcome.FAILED:
            raise RunError(f"{reason}; `{resume}` tries again")
        return self._state

    def _to_the_end(self) -> tuple[Outcome, str]:
        """Returns how the run ended and why; whatever ends it, what has landed is recorded."""
        try:
            return self._loop()
        finally:
            self._journal.record(self._writers.close())

    def _loop(self) -> tuple[Outcome, str]:
        while (end := self._next()) is None:
            self._take_messages()
            if self._wrong is not None:
                self._wind_down()
                raise self._wrong
            self._take_requests()
            if self._stop.requested:
                self._wind_down()
                raise KeyboardInterrupt
            saving = self._writers.expected(self._state, self._attempts)
            if (reached := self._purse.reached(saving, self._machines.idle)) is not None:
                self._end_training(reached)
        return end

    def _while_it_waits(self) -> None:
        """A wait for the disk outlasts neither a request to stop nor a limit. Raises as both."""
        self._requests.poll()
        self._purse.require(self._machines.idle)

    def _end_training(self, reached: BudgetReached) -> None:
        """Ends all tasks with fresh checkpoints: what follows is made of what there is."""
        self._wind_down()
        started = [task for task in self._attempts if self._state.status(task) == Status.RUNNING]
        for task in list(self._attempts):
            self._pool.cancel(task)
            self._forget(task)
        measures = 0 if self._state.plan else len(self._results.specs.measures)
        self._journal.record([*map(TaskYielded, started), replace(reached, measures=measures)])
        self._news = True

    def _take_requests(self) -> None:
        self._news = self._requests.carry_out() or self._news
        ends = self._own_machine_leaves
        for task, attempt in list(self._attempts.items()):
            leaves = ends or bool(self._machines.leaves(attempt.placement.node))
            if leaves and not attempt.ready:  # it has not begun: nothing is lost
                self._pool.cancel(task)
                self._forget(task)
                self._news = True
            held = self._state.task(task).held or (leaves and task.stage.trains)
            if held and attempt.ready and not attempt.stopping:
                self._stop_task(task)

    @property
    def _own_machine_leaves(self) -> bool:  # and with it the run, wherever its tasks are
        return leaves_for_sure(self._state.leaving(), gethostname())

    def _stop_task(self, task: TaskId) -> None:
        self._attempts[task].stopping = True
        self._pool.stop(task)

    def _next(self) -> tuple[Outcome, str] | None:
        """Starts what can start, if anything has happened. Returns how the run has ended, if it has."""
        self._purse.see(self._pool.nodes())
        there, changed = self._machines.review()
        nodes, job = tuple(there), self._job
        self._news = self._news or changed
        if self._news or nodes != self._nodes or self._clock.monotonic() >= self._again:
            self._nodes, self._news, self._again = nodes, False, math.inf
            ready = job.ready(self._state)
            if (end := outcome(self._state, ready)) is not None:
                return end
            if not self._attempts and (why := quarantine.hopeless(self._state, ready, nodes)):
                return Outcome.FAILED, why
            self._start_ready(ready)
            if not self._attempts and (why := self._purse.gives_up(job.config.scaling.patience)):
                return Outcome.LIMITED, why
        turn = self._clock.monotonic() + _STARTS_S
        while self._placed and self._clock.monotonic() <= turn:
            self._start(*self._placed.pop(0))
        return None

    def _start_ready(self, ready: Sequence[TaskId]) -> None:
        tasks = [task for task in ready if task not in self._attempts and not self._writers.writes(task)]
        if len(tasks) != 1 or (make := self._results.maker(tasks[0], self._state)) is None:
            self._place(() if self._own_machine_leaves else tasks)
            return
        self._place(())  # takes requests for machines back
        with self._stop.at_once():
            records = self._journal.until_done(make)
        self._news = True
        self._journal.record(records)

    def _place(self, tasks: Sequence[TaskId]) -> None:
        demands = Demands(self._sizes, self._state)
        running = demands.running({t: it.placement for t, it in self._attempts.items()}, self._clock.time())
        nodes = quarantine.usable(self._state, self._nodes)
        self._placed = self._machines.place(demands, tasks, running, nodes)
        known = ((task, self._state.tasks.get(task)) for task in tasks)
        if any(state and state.failures and task not in self._attempts for task, state in known):
            self._again = self._clock.monotonic() + _REVIEW_S
        if self._machines.expecting:
            self._again = self._clock.monotonic() + _LOOK_S

    def _start(self, task: TaskId, where: Placement) -> None:
        specs = self._specs if task.stage in (Stage.DISTRICT, Stage.COARSE) else self._results.specs
        spec = self._journal.until_done(lambda: specs.of(task))
        state, iteration = self._state.task(task), 0
        if isinstance(spec, TrainSpec) and spec.checkpoint is not None:
            iteration = checkpoint.iteration_of(self._job.folder.checkpoint(task))
        if isinstance(spec, EvaluateSpec):
            self._evaluations[task] = new_evaluation(self._job, len(spec.faces), spec.views)
        else:
            node = next(node for node in self._nodes if node.id == where.node)
            need = self._sizes.of(task, self._state)
            cache = image_cache(spec.config.cache, where, node, need, state.shortages)
            spec = replace(spec, config=spec.config.model_copy(update={"cache": cache}))
        if isinstance(spec, TrainSpec):
            token, attempt = self._presence.token, state.attempts + 1
            outbox = self._journal.until_done(lambda: make_outbox(self._job.folder, task, attempt, token))
            spec = replace(spec, outbox=outbox)
        self._attempts[task] = Attempt(spec, state.attempts + 1, iteration, where, self._clock.monotonic())
        self._pool.start(where, self._hooks.on_start(spec))
        place = f"node {where.node[:8]}, {where.kind}, {where.threads} threads, {gib(where.memory)}"
        _LOG.info("%s: attempt %d from iteration %d on %s", task, state.attempts + 1, iteration, place)

    def _wind_down(self) -> None:
        """Requests a last checkpoint of all tasks that train, and waits for these, but not for ever."""
        self._placed.clear()
        training = [task for task, attempt in self._attempts.items() if attempt.ready and task.stage.trains]
        self._journal.record([StopRequested(len(training))])
        for task in training:
            self._stop_task(task)
        last = self._clock.monotonic() + self._writers.grace(self._state, training)
        while not self._attempts.keys().isdisjoint(training) and self._clock.monotonic() < last:
            self._take_messages()

    def _take_messages(self) -> None:
        """Handles at most one message of each task, and records all of it at once, also before an error.

        Large messages are taken before what is written is recorded: the disk is busy meanwhile.
        """
        records: list[Record] = []
        try:
            records.extend(self._writers.finished())
            written = {record.task for record in records if isinstance(record, CheckpointSaved | ModelSaved)}
            self._news = self._news or not written <= self._attempts.keys()
            held_up = written | self._writers.held_up()  # what follows relies on what is recorded
            for task in held_up & self._attempts.keys():
                self._attempts[task].latest = self._clock.monotonic()
            at_once = records or self._placed or self._news or self._writers.busy
            ready = self._pool.ready(0 if at_once else _WAIT_S, held_up)
            self._deadlines.turn(self._attempts.values(), ready)
            for task in ready:
                records += self._take(task)
            records += self._end_overdue()
        finally:
            self._journal.record(self._purse.with_lost(records))
        if not ready and not records and self._writers.busy:
            self._writers.wait(_TURN_S)

    def _end_overdue(self) -> list[Record]:
        """Ends workers that hang. A task that has its result is done; so has what it was stopped for."""
        records: list[Record] = []
        for attempt, reason in self._deadlines.overdue(self._attempts.values()):
            task = attempt.spec.task
            if not attempt.ready and self._pool.waiting(task):
                attempt.latest = self._clock.monotonic()
                continue
            self._pool.cancel(task)
            self._news = True
            evaluated = task in self._evaluations and self._evaluations[task].complete
            if evaluated or attempt.stopping or self._state.status(task) == Status.DONE:
                records += self._ended(task)
            else:
                records.append(self._failed(task, Failed(reason, Failure.LOST)))
        return records

    def _take(self, task: TaskId) -> Sequence[Record]:
        """Saves the content of the next message of a task; nothing of it stays in memory."""
        message, attempt = self._pool.take(task), self._attempts[task]
        self._news = self._news or isinstance(message, _ENDS)
        match message:
            case Hello():
                return [attempt.started(message, self._nodes)]
            case Ended():
                return self._ended(task)
            case Failed() if self._state.status(task) == Status.DONE:
                return self._ended(task)  # a worker that dies after its result was saved is done
            case Failed():
                failed = self._failed(task, message)
                if failed.kind == Failure.INPUT and failed.final and not task.stage.refines:
                    self._wrong = InputError(message.reason)
                return [failed]
            case Usage():
                self._journal.until_done(lambda: self._usages.keep(message))
                return []
            case Large():
                self._writers.announce(task, message.size)
                return []
            case Checkpoint() | Trained():
                self._writers.start(message)
                return []
            case LpipsMissing() if task.stage is Stage.MEASURE:
                self._evaluations[task].add(message)
                return []  # the evaluation says it once
            case Calibration():
                raise RunError(f"{task}: a calibration is not an event of a run")
            case _:
                record = self._journal.until_done(lambda: self._save(message), payload(message))
                if isinstance(message, CheckpointWritten) and isinstance(record, CheckpointSaved):
                    self._writers.measured(record, message.seconds)
                return [record]

    def _save(self, event: Event) -> Record:
        """Puts what an event carries into the run folder. A writer's thread may call it."""
        if (evaluation := self._evaluations.get(event.task)) is not None:
            evaluation.add(event)
        return save(self._job.folder, event, self._job.scene, self._job.config.retention.checkpoints)

    def _ended(self, task: TaskId) -> list[Record]:
        """What follows the end of a task. One without its result has failed, unless it was stopped."""
        self._writers.forget(task)
        if (evaluation := self._evaluations.pop(task, None)) is not None:
            del self._attempts[task]
            return [self._journal.until_done(lambda: self._results.measured(task, evaluation))]
        done, records = self._state.status(task) == Status.DONE, list[Record]()
        if done:
            self._journal.until_done(lambda: remove_checkpoints(self._job.folder, task))
        elif self._attempts[task].stopping:
            records = [TaskYielded(task, self._machines.leaves(self._attempts[task].placement.node))]
        elif not self._stop.requested:
            return [self._failed(task, Failed("the worker ended without a result"))]
        del self._attempts[task]
        return records

    def _forget(self, task: TaskId) -> Attempt:
        self._evaluations.pop(task, None)
        self._writers.forget(task)
        return self._attempts.pop(task)

    def _failed(self, task: TaskId, message: Failed) -> TaskFailed:
        attempt = self._forget(task)
        if message.kind == Failure.LOST:
            self._machines.review()  # its machine may have announced that it leaves a moment ago
        return attempt.failed(message, self._state, self._nodes, self._job.config)
