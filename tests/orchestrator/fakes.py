"""Workers that say what a test tells them to, and a job whose drivers come and go."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.driver.stopping import Stop
from panolog.orchestrator.resources.messages import Ended, Failed, Hello, Message
from panolog.orchestrator.resources.nodes import Node, Place
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import LOST, RunBegan
from panolog.orchestrator.run.state import RunState, replay
from panolog.orchestrator.run.store import Database, read_milestones, read_records
from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.ply import read_ply
from panolog.workers.events import Checkpoint, Evaluated, Event, Progress, Scored, Trained
from panolog.workers.merge import retained
from panolog.workers.training.initialise import scene_gaussians
from tests.workers.small import WIDTH, small_scene

Script = Callable[[str, dict[str, Any]], Iterator[Event]]
MACHINE = Node("node", "host", cpus=2, memory=2**40)
LOST_NODE = Failed("the worker's machine died or cannot be reached", LOST)
DIED = Failed("WorkerCrashedError: the worker died")


class CrashError(Exception):
    """A worker's end as the script wants it."""

    def __init__(self, failed: Failed) -> None:
        super().__init__(failed.reason)
        self.failed = failed


class FakePool:
    """Runs scripts in this thread, one message of each task at a time; complains of tasks without a place."""

    def __init__(self, script: Script, nodes: Sequence[Node]) -> None:
        self._script = script
        self._nodes = list(nodes)
        self._running: dict[str, Iterator[Message]] = {}
        self.started: list[tuple[str, Place]] = []
        self.fields: list[dict[str, Any]] = []
        self.stopped: set[str] = set()
        self.most = 0  # tasks that ran at the same time
        self._when_waiting: Callable[[], None] | None = None

    def nodes(self) -> tuple[Node, ...]:
        return tuple(self._nodes)

    def lose(self, *nodes: str) -> None:
        """These are gone, and what runs there with them."""
        self._nodes = [node for node in self._nodes if node.id not in nodes]
        for name in self._running:
            if self.place(name).node in nodes:
                self._running[name] = iter([LOST_NODE])

    def when_waiting(self, action: Callable[[], None]) -> None:
        """What happens when the driver waits although nothing runs."""
        self._when_waiting = action

    def join(self, node: Node) -> None:
        self._nodes.append(node)

    def place(self, name: str) -> Place:
        """Where a task was last started."""
        return dict(self.started)[name]

    def put(self, value: object) -> Any:
        return value

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        return here

    def start(self, name: str, place: Place, work: object, fields: dict[str, Any]) -> None:
        assert name not in self._running, "it is trained twice"
        assert place.node in {node.id for node in self._nodes}
        self.started.append((name, place))
        self.fields.append(fields)
        self.stopped.discard(name)
        self._running[name] = self._messages(name, fields)

    def stop(self, name: str) -> None:
        self.stopped.add(name)

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
        if not self._running and self._when_waiting is not None:
            self._when_waiting()
        self.most = max(self.most, len(self._running))
        messages = [(name, next(task)) for name, task in self._running.items()]
        for name, message in messages:
            if isinstance(message, Ended | Failed):
                del self._running[name]
        return messages

    def _messages(self, name: str, fields: dict[str, Any]) -> Iterator[Message]:
        yield Hello("node", 1)
        try:
            yield from self._script(name, fields)
        except CrashError as crash:
            yield crash.failed
            return
        yield Ended()


def well(name: str, fields: dict[str, Any]) -> Iterator[Event]:
    """What a worker says when all goes well."""
    if name.startswith("score/"):
        yield Scored(name, fields["views"], torch.ones(len(fields["views"]), fields["blocks"]).double())
    elif name == "eval":
        png = bytes(cv2.imencode(".png", np.zeros((WIDTH // 2, WIDTH, 3), np.uint8))[1])
        scene = fields["scene"]
        for row in fields["views"]:
            yield Evaluated(name, scene.panoramas[row].name, {"psnr": 20.0 + row, "lpips": None}, png)
    else:
        yield Progress(name, 1, 2, 3.0, loss=0.5)
        if fields["checkpoint"] is None:
            yield Checkpoint(name, 1, {"iteration": torch.tensor(1)})
        yield Trained(name, trained(fields), 2, 0.1)


def trained(fields: dict[str, Any]) -> Gaussians:
    """The sparse cloud with two sky Gaussians; for a block its share of the initial model, brighter."""
    if fields.get("cell") is None:
        gaussians = scene_gaussians(fields["scene"])
        sky = gaussians.select(torch.arange(len(gaussians)) < 2)
        return concatenate(gaussians, replace(sky, sky=2))
    cut = retained(read_ply(fields["initial"]), fields["cell"], 0.0)
    return replace(cut, sh0=cut.sh0 + 1)


class Harness:
    """A job in a folder, and drivers that come and go."""

    def __init__(self, folder: Path, nodes: Sequence[Node] = (MACHINE,), **settings: Any) -> None:
        self.nodes = nodes
        self.folder = RunFolder(folder / "run")
        self.folder.root.mkdir()
        (folder / "scene").mkdir()
        config = RunConfig(width=WIDTH, **{"device": "cpu", **settings})
        self.job = Job(self.folder, small_scene(folder / "scene"), config)
        self.pool = FakePool(well, nodes)
        self.stop = Stop()

    def drive(self, script: Script = well, *, resumed: bool = False) -> RunState:
        self.pool, self.stop = FakePool(script, self.nodes), Stop()
        with closing(Database(self.folder.database)) as database:
            driver = Driver(self.job, database, self.pool, lambda state, news: None, self.stop)
            return driver.run(RunBegan("host", 1, resumed))

    def attempts(self, task: str) -> list[tuple[Place, dict[str, Any]]]:
        """Place and fields of each attempt of the last driver at a task."""
        both = zip(self.pool.started, self.pool.fields, strict=True)
        return [(place, fields) for (name, place), fields in both if name == task]

    @property
    def state(self) -> RunState:
        return replay(read_milestones(self.folder.database))

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.pool.started]

    def records(self, kind: type) -> list[Any]:
        return [s.record for s in read_records(self.folder.database) if isinstance(s.record, kind)]


def fails(task: str, failed: Failed, times: int, before: Sequence[Event] = ()) -> Script:
    """All goes well but for the first attempts at one task."""
    left = [times]

    def script(name: str, fields: dict[str, Any]) -> Iterator[Event]:
        if name == task and left[0]:
            left[0] -= 1
            yield from before
            raise CrashError(failed)
        yield from well(name, fields)

    return script
