"""Workers that follow a script of a test, and a job whose drivers come and go."""

from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from contextlib import closing
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from panolog.orchestrator.cli.session.delivery import deliver
from panolog.orchestrator.engine.driver.driver import Driver, Hooks
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.driver.requests import Stop
from panolog.orchestrator.engine.scheduling.large_messages import announced
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.pool import NONE, Ended, Failed, Hello, InProcess, Message, Pool
from panolog.orchestrator.runs.clock import CLOCK, Clock
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.database import Database, read_milestones, read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.records import Failure, RunBegan
from panolog.orchestrator.runs.state import OnChange, RunState, ignore, replay
from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.events import Calibration, Checkpoint, Evaluated, Event, Scored, SeamMeasured, Trained
from panolog.workers.merge import retained
from panolog.workers.scoring import ScoreSpec
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import Progress, TaskId
from panolog.workers.training.initialise import scene_gaussians
from panolog.workers.training.trainer import TrainSpec
from tests.workers.seams.test_schema import FACES
from tests.workers.small import WIDTH, small_scene

Script = Callable[[TaskSpec], Iterator[Event | Calibration]]
MACHINE = Node("node", "host", cpus=2, memory=2**40)
LOST_NODE = Failed("the worker's machine died or cannot be reached", Failure.LOST)
DIED = Failed("WorkerCrashedError: the worker died")


class CrashError(Exception):
    """The end of a worker in a script."""

    def __init__(self, failed: Failed) -> None:
        super().__init__(failed.reason)
        self.failed = failed


class SetClock:
    """A clock that stands where it was set."""

    def __init__(self) -> None:
        self.now = 1e9

    def time(self) -> float:
        return self.now

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class FakePool(InProcess):
    """Runs scripts in this thread, one message of each task at a time; fails on tasks without a placement."""

    def __init__(self, script: Script, nodes: Sequence[Node]) -> None:
        self._script = script
        self._nodes = list(nodes)
        self._running: dict[TaskId, Iterator[Message]] = {}
        self.started: list[tuple[Placement, TaskSpec]] = []
        self.stopped: set[TaskId] = set()
        self.leaving: dict[str, LeaveNotice] = {}  # by Node.id
        self.card = ""  # the GPU that each task reports
        self.most = 0  # tasks that ran at the same time
        self._when_waiting: Callable[[], None] | None = None

    @property
    def tasks(self) -> list[TaskId]:
        """Those that were started, in order."""
        return [spec.task for _, spec in self.started]

    def nodes(self) -> tuple[Node, ...]:
        return tuple(self._nodes)

    def notices(self) -> dict[str, LeaveNotice]:
        return dict(self.leaving)

    def leave(self, node: str) -> None:
        """It is gone; what runs there reports that itself."""
        self._nodes = [other for other in self._nodes if other.id != node]
        self.leaving.pop(node, None)

    def lose(self, *nodes: str) -> None:
        """These are gone, and what runs there with them."""
        self._nodes = [node for node in self._nodes if node.id not in nodes]
        for task in self._running:
            if self.placement(task).node in nodes:
                self._running[task] = iter([LOST_NODE])

    def when_waiting(self, action: Callable[[], None]) -> None:
        """What happens when the driver waits although nothing runs."""
        self._when_waiting = action

    def join(self, node: Node) -> None:
        self._nodes.append(node)

    @property
    def running(self) -> list[TaskId]:
        """The tasks that run now."""
        return list(self._running)

    def placement(self, task: TaskId) -> Placement:
        """Where a task was last started."""
        return next(where for where, spec in reversed(self.started) if spec.task == task)

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        assert spec.task not in self._running, "it is trained twice"
        assert placement.node in {node.id for node in self._nodes}
        self.started.append((placement, spec))
        self.stopped.discard(spec.task)
        self._running[spec.task] = self._messages(spec)

    def stop(self, task: TaskId) -> None:
        self.stopped.add(task)

    def waiting(self, task: TaskId) -> bool:
        return False

    def cancel(self, task: TaskId) -> None:
        del self._running[task]

    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        if not self._running and self._when_waiting is not None:
            self._when_waiting()
        self.most = max(self.most, len(self._running))
        return [task for task in self._running if task not in ignored]

    def take(self, task: TaskId) -> Message:
        message = next(self._running[task])
        if isinstance(message, Ended | Failed):
            del self._running[task]
        return message

    def _messages(self, spec: TaskSpec) -> Iterator[Message]:
        yield Hello("node", 1, card=self.card)
        try:
            yield from announced(self._script(spec))
        except CrashError as crash:
            yield crash.failed
            return
        yield Ended()


class Noting(InProcess):
    """Takes the place of a pool, and notes which files a task is given."""

    def __init__(self) -> None:
        self.scene: set[Path] = set()
        self.run: set[Path] = set()

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        self.scene, self.run = set(scene), set(run)
        return here


def well(spec: TaskSpec) -> Iterator[Event]:
    """The events of a worker when all goes well."""
    task = spec.task
    match spec:
        case ScoreSpec():
            yield Scored(task, spec.views, torch.ones(len(spec.views), spec.blocks).double())
        case EvaluateSpec():
            png = bytes(cv2.imencode(".png", np.zeros((WIDTH // 2, WIDTH, 3), np.uint8))[1])
            scene = spec.scene.load()
            for row in spec.views:
                yield Evaluated(task, scene.panoramas[row].name, {"psnr": 20.0 + row, "lpips": None}, png)
            for plane in () if spec.seams is None else spec.seams.faces:
                seam = FACES[0].model_copy(update={"blocks": (plane.below, plane.above)})
                yield SeamMeasured(task, seam, {"merged.jpg": b"a picture"})
        case TrainSpec():
            yield Progress(task, 1, 2, 3.0, loss=0.5)
            if spec.checkpoint is None:
                yield Checkpoint(task, 1, {"iteration": torch.tensor(1)})
            yield Trained(task, trained(spec), 2, 0.1)


def trained(spec: TrainSpec) -> Gaussians:
    """The sparse cloud with two sky Gaussians; for a block its share of the initial model, brighter."""
    if spec.cell is None or spec.initial is None:
        gaussians = scene_gaussians(spec.scene.load())
        sky = gaussians.select(torch.arange(len(gaussians)) < 2)
        return concatenate(gaussians, replace(sky, sky=2))
    cut = retained(spec.initial.load(), spec.cell, 0.0)
    return replace(cut, sh0=cut.sh0 + 1)


class Harness:
    """A job in a folder, without passes and delivery unless the settings have them, and its drivers."""

    def __init__(self, folder: Path, nodes: Sequence[Node] = (MACHINE,), **settings: Any) -> None:
        self.nodes = nodes
        self.folder = RunFolder(folder / "run")
        self.folder.root.mkdir()
        (folder / "scene").mkdir()
        config = RunConfig(
            width=WIDTH, **{"device": "cpu", "passes": {"repair": 0.0}, "deliver": False, **settings}
        )
        self.job = Job(self.folder, small_scene(folder / "scene"), config)
        self.pool = FakePool(well, nodes)
        self.stop = Stop()
        self.clock: Clock = CLOCK

    def drive(
        self,
        script: Script = well,
        *,
        resumed: bool = False,
        pool: Pool | None = None,
        hooks: Hooks = Hooks(deliver=deliver),  # noqa: B008  # it is frozen
        on_change: OnChange = ignore,
        database: Callable[[Path, Clock], Database] = Database,
    ) -> RunState:
        """Runs one driver to its end. Args: pool, in place of the one that runs the script."""
        self.stop = Stop()
        if pool is None:
            pool = FakePool(script, self.nodes)
        if isinstance(pool, FakePool):
            self.pool = pool
        with closing(database(self.folder.database, self.clock)) as opened:
            opened.append([RunBegan("host", 1, resumed)])
            journal = Journal(opened, on_change, self.clock)
            return Driver(self.job, journal, pool, hooks, self.stop).run()

    def at(self, root: Path) -> "Harness":
        """A harness of this job in another run folder."""
        other = copy(self)
        other.folder = RunFolder(root)
        root.mkdir(exist_ok=True)
        other.job = replace(self.job, folder=other.folder)
        return other

    def attempts(self, task: TaskId) -> list[tuple[Placement, TaskSpec]]:
        """Placement and spec of each attempt of the last driver at a task."""
        return [(where, spec) for where, spec in self.pool.started if spec.task == task]

    def trainings(self, task: TaskId) -> list[TrainSpec]:
        """The spec of each attempt of the last driver at a task that trains."""
        return [spec for _, spec in self.attempts(task) if isinstance(spec, TrainSpec)]

    @property
    def state(self) -> RunState:
        return replay(read_milestones(self.folder.database))

    @property
    def tasks(self) -> list[TaskId]:
        return self.pool.tasks

    def records(self, kind: type) -> list[Any]:
        return [s.record for s in read_records(self.folder.database) if isinstance(s.record, kind)]


def begins(
    task: TaskId, *steps: Any, times: int = 1, rest: Callable[[TaskSpec], Iterator[Any]] = well
) -> Script:
    """All goes well, but the first attempts at one task begin with steps: events, errors and actions.

    Args: rest, the script of what follows these, and of all else.
    """
    left = [times]

    def script(spec: TaskSpec) -> Iterator[Any]:
        if spec.task == task and left[0]:
            left[0] -= 1
            for step in steps:
                if isinstance(step, BaseException):
                    raise step
                if callable(step):
                    step()
                else:
                    yield step
        yield from rest(spec)

    return script


def fails(task: TaskId, failed: Failed, times: int, before: Sequence[Event] = ()) -> Script:
    """All goes well but for the first attempts at one task."""
    return begins(task, *before, CrashError(failed), times=times)
