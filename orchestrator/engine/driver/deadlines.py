"""When a silent worker counts as hung.

Only time in which the driver listens counts. A long time between two turns of its loop is its own: it has
saved, merged or waited for a full disk, or its machine was asleep.
"""

from collections import deque
from collections.abc import Collection, Iterable

from panolog.orchestrator.engine.driver.attempts import Attempt
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.estimates.calibration import basis_of
from panolog.orchestrator.runs.clock import Clock
from panolog.workers.tasks import TaskId

_TURN_S = 5.0  # of one turn of the driver's loop that count, at most
_TIMES = 10  # usual intervals: no task that works is silent for so long
_KEPT = 16  # intervals of a task, whose upper quartile is the usual one: small messages come in groups


class Deadlines:
    """The intervals between messages of all tasks, over their attempts."""

    def __init__(self, job: Job, clock: Clock) -> None:
        self._config = job.config.deadlines
        self._clock = clock
        measured = basis_of(job.folder, job.scene, job.config).measured
        # seconds for what comes before the first iteration, or for one iteration where cores are shared
        self._expected = max(measured.begin, measured.single, measured.grown.seconds)
        self._intervals: dict[TaskId, deque[float]] = {}  # seconds
        self._turned = clock.monotonic()

    def turn(self, attempts: Iterable[Attempt], ready: Collection[TaskId]) -> None:
        """One turn of the driver's loop. Args: ready, the tasks that have a message now."""
        now = self._clock.monotonic()
        away = max(0.0, now - self._turned - _TURN_S)
        self._turned = now
        came = set(ready)  # of thousands, a search for each attempt would take the driver's time
        for attempt in attempts:
            attempt.latest = min(now, attempt.latest + away)
            task = attempt.spec.task
            if task in came:
                if attempt.ready:
                    self._intervals.setdefault(task, deque(maxlen=_KEPT)).append(now - attempt.latest)
                attempt.latest = now

    def overdue(self, attempts: Iterable[Attempt]) -> list[tuple[Attempt, str]]:
        """The attempts that are silent for too long, each with the reason for its failure."""
        found: list[tuple[Attempt, str]] = []
        for attempt in attempts:
            silent = self._turned - attempt.latest
            if not attempt.ready and silent > self._config.hello:
                reason = f"no message for {silent:.0f} s since its start: the worker does not begin"
                found.append((attempt, reason))
            elif silent > self._config.message and attempt.ready and silent > self._limit(attempt.spec.task):
                found.append((attempt, f"no message for {silent:.0f} s: the worker hangs"))
        return found

    def _limit(self, task: TaskId) -> float:
        """Seconds between two messages of a task that works, at most."""
        intervals = sorted(self._intervals.get(task, ()))
        usual = intervals[len(intervals) * 3 // 4] if intervals else 0.0
        return _TIMES * max(usual, self._expected)
