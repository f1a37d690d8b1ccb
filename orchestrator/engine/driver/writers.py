"""Threads that write what is large, so that the driver's loop handles other messages meanwhile.

A worker announces a large message. The driver takes such a one only while it holds fewer than `LARGE`: this
bounds its memory whatever the number of tasks, and the rest stays with the workers. Nothing more of a task is
taken while its message is written, so the records of each task stay in order.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import dataclass

from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.estimates.calibration import CHECKPOINT
from panolog.orchestrator.runs.clock import CLOCK, Clock
from panolog.orchestrator.runs.records import CheckpointSaved, ModelSaved, Record
from panolog.orchestrator.runs.state import RunState
from panolog.workers.events import Checkpoint, Event, Trained
from panolog.workers.tasks import TaskId

LARGE = 2  # messages in memory, and as many threads: two use a disk better (docs/design.md)
GRACE_S = 60.0  # at least, in which tasks that are requested to stop must have yielded their checkpoints
_UNMEASURED = 2**26  # bytes per second, expected of a disk before anything large was written


@dataclass
class _Job:
    event: Checkpoint | Trained
    size: int  # bytes, 0 = unknown
    future: Future[tuple[Record, float]]
    refused: bool = False  # by the disk: tried again when the journal is


class Writers:
    """The large messages that a driver holds."""

    def __init__(self, save: Callable[[Event], Record], journal: Journal, clock: Clock = CLOCK) -> None:
        """Args: save, writes what an event carries, in a thread."""
        self._save = save
        self._journal = journal
        self._clock = clock
        self._threads = ThreadPoolExecutor(LARGE, "writer")
        self._jobs: dict[TaskId, _Job] = {}
        self._announced: dict[TaskId, int] = {}  # bytes of the next message
        self._bytes = self._seconds = 0.0  # of all that was written

    @property
    def busy(self) -> bool:
        return bool(self._jobs)

    def announce(self, task: TaskId, size: int) -> None:
        """The next message of a task has so many bytes."""
        self._announced[task] = size

    def held_up(self) -> set[TaskId]:
        """The tasks of which nothing can be taken now."""
        room = max(0, LARGE - len(self._jobs))  # for those that were announced first
        return set(self._jobs).union(list(self._announced)[room:])

    def writes(self, task: TaskId) -> bool:
        return task in self._jobs

    def start(self, event: Checkpoint | Trained) -> None:
        size = self._announced.pop(event.task, 0)
        self._jobs[event.task] = _Job(event, size, self._threads.submit(self._write, event))

    def forget(self, task: TaskId) -> None:
        """A task has ended: nothing more comes of it."""
        self._announced.pop(task, None)

    def finished(self) -> Iterator[Record]:
        """The records of what is on the disk now; tries again what the disk has refused.

        Raises OSError or RunError, after all records, if writing has failed for a reason that will not pass.
        """
        failure: BaseException | None = None
        for task, job in list(self._jobs.items()):
            if job.refused:
                if self._clock.monotonic() >= self._journal.again:
                    job.refused, job.future = False, self._threads.submit(self._write, job.event)
                continue
            if not job.future.done():
                continue
            error = job.future.exception()
            job.refused = error is not None and self._journal.refused(error, job.size)
            if job.refused:
                continue
            del self._jobs[task]
            if error is not None:
                failure = failure or error
                continue
            record, seconds = job.future.result()
            if isinstance(record, CheckpointSaved | ModelSaved):
                self.measured(record, seconds)
            self._journal.accepted()
            yield record
        if failure is not None:
            raise failure

    def wait(self, seconds: float) -> None:
        if futures := [job.future for job in self._jobs.values() if not job.refused]:
            wait_for(futures, seconds, FIRST_COMPLETED)
        else:
            self._clock.sleep(seconds)

    def close(self) -> list[Record]:
        """Waits for what is being written and gives up what the disk has refused. Returns what landed."""
        self._threads.shutdown(wait=True)
        done = [job.future for job in self._jobs.values() if job.future.exception() is None]
        self._jobs.clear()
        return [future.result()[0] for future in done]

    def measured(self, record: CheckpointSaved | ModelSaved, seconds: float) -> None:
        """Takes note of how long something took to write, here or by a worker."""
        self._bytes += record.size
        self._seconds += seconds

    def grace(self, state: RunState, tasks: Iterable[TaskId]) -> float:
        """Seconds in which tasks that train must have saved a checkpoint, and those that a slow one gets."""
        return GRACE_S + self.expected(state, tasks)

    def expected(self, state: RunState, tasks: Iterable[TaskId]) -> float:
        """Seconds in which they save a checkpoint at the rate measured so far."""
        progress = [state.task(task).progress for task in tasks]
        size = CHECKPOINT * sum(p.gaussians or 0 for p in progress if p is not None)
        return size * (self._seconds / self._bytes if self._bytes else 1 / _UNMEASURED)

    def _write(self, event: Checkpoint | Trained) -> tuple[Record, float]:
        began = self._clock.monotonic()
        return self._save(event), self._clock.monotonic() - began
