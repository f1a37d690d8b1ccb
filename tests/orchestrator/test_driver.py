"""The driver with workers that say what the test tells them to, without Ray."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from panolog.orchestrator.config import RunConfig
from panolog.orchestrator.database import Database, read_milestones, read_records
from panolog.orchestrator.driver import Driver
from panolog.orchestrator.messages import Ended, Failed, Hello, Message
from panolog.orchestrator.nodes import Node, Place
from panolog.orchestrator.records import INPUT, RunBegan, RunEnded, TaskFailed, TaskStarted
from panolog.orchestrator.run_folder import RunFolder
from panolog.orchestrator.stages import Job
from panolog.orchestrator.state import FAILED, RunState, replay
from panolog.scene.errors import InputError, RunError
from panolog.scene.files import Locate, here
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.ply import ply_header, read_ply
from panolog.workers.cut import retained
from panolog.workers.events import Checkpoint, Evaluated, Event, Progress, Scored, Trained
from panolog.workers.initialise import scene_gaussians
from tests.workers.small import WIDTH, small_scene

Script = Callable[[str, dict[str, Any]], Iterator[Event]]
DIED = Failed("WorkerCrashedError: the worker died")


class CrashError(Exception):
    """A worker's end as the script wants it."""

    def __init__(self, failed: Failed) -> None:
        super().__init__(failed.reason)
        self.failed = failed


class FakePool:
    """Runs scripts in this thread, one message of each task at a time."""

    def __init__(self, script: Script) -> None:
        self._script = script
        self._running: dict[str, Iterator[Message]] = {}
        self.started: list[tuple[str, int]] = []
        self.fields: list[dict[str, Any]] = []

    def nodes(self) -> tuple[Node, ...]:
        return (Node("node", "host", cpus=2, memory=2**40),)

    def put(self, value: object) -> Any:
        return value

    def share_files(self, root: Path, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        return here

    def start(self, name: str, place: Place, work: object, fields: dict[str, Any]) -> None:
        self.started.append((name, place.threads))
        self.fields.append(fields)
        self._running[name] = self._messages(name, fields)

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
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

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.folder = RunFolder(folder / "run")
        self.folder.root.mkdir()
        (folder / "scene").mkdir()
        config = RunConfig(width=WIDTH, device="cpu", **settings)
        self.job = Job(self.folder, small_scene(folder / "scene"), config)
        self.pool = FakePool(well)

    def drive(self, script: Script = well, *, resumed: bool = False) -> RunState:
        self.pool = FakePool(script)
        database = Database(self.folder.database)
        try:
            return Driver(self.job, database, self.pool, lambda state, news: None).run(
                RunBegan("host", 1, resumed)
            )
        finally:
            database.close()

    @property
    def state(self) -> RunState:
        return replay(read_milestones(self.folder.database))

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.pool.started]

    def records(self, kind: type) -> list[Any]:
        return [s.record for s in read_records(self.folder.database) if isinstance(s.record, kind)]


@pytest.fixture
def harness(tmp_path: Path) -> Harness:
    return Harness(tmp_path)


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


def test_a_run_ends_with_everything_in_its_place(harness: Harness) -> None:
    state = harness.drive()
    assert harness.names == ["coarse", "score/000", *sorted(harness.names[2:4]), "eval"]
    assert harness.pool.started[0] == ("coarse", 2)
    assert [cpus for name, cpus in harness.pool.started if name.startswith("block/")] == [1, 1]
    assert (state.outcome, state.metrics) == ("done", {"psnr": 24.0, "lpips": None})
    assert ply_header(harness.folder.point_cloud) == (202, 2)
    for path in (harness.folder.plan, harness.folder.plan_picture, harness.folder.scores):
        assert path.is_file()
    assert len(list(harness.folder.images.iterdir())) == len(harness.job.scene.test)
    assert not list(harness.folder.root.rglob("checkpoint.safetensors"))
    assert harness.state == state


def test_a_dead_worker_goes_on_from_its_checkpoint(harness: Harness) -> None:
    saved = Checkpoint("coarse", 7, {"x": torch.arange(3)})
    harness.drive(fails("coarse", DIED, 1, before=[saved]))
    first, second = harness.pool.fields[:2]
    assert first["checkpoint"] is None
    assert second["checkpoint"] == harness.folder.checkpoint("coarse")
    assert [(s.attempt, s.iteration) for s in harness.records(TaskStarted)][:2] == [(1, 0), (2, 7)]
    task = harness.state.task("coarse")
    assert (task.retries, task.reasons) == (1, (DIED.reason,))


def test_a_block_that_keeps_failing_keeps_its_stage_one_gaussians(harness: Harness) -> None:
    with pytest.raises(RunError, match="block 1 failed and keeps its Stage I Gaussians"):
        harness.drive(fails("block/001", DIED, 99))
    assert harness.names.count("block/001") == 1 + harness.job.config.retries
    assert harness.state.status("block/001") == FAILED
    assert harness.state.outcome == "failed"
    assert ply_header(harness.folder.point_cloud) == (202, 2)  # nothing is missing
    assert harness.folder.metrics.exists()
    kept = read_ply(harness.folder.kept(1))
    merged = read_ply(harness.folder.point_cloud)
    assert any(torch.equal(row, kept.sh0[0]) for row in merged.sh0)


def test_resume_tries_a_failed_block_again_and_merges_anew(harness: Harness, tmp_path: Path) -> None:
    with pytest.raises(RunError):
        harness.drive(fails("block/001", DIED, 99))
    state = harness.drive(resumed=True)
    assert harness.names == ["block/001", "eval"]
    assert state.outcome == "done"
    (tmp_path / "other").mkdir()
    undisturbed = Harness(tmp_path / "other")
    undisturbed.drive()
    assert harness.folder.point_cloud.read_bytes() == undisturbed.folder.point_cloud.read_bytes()


def test_stage_one_failing_for_good_ends_the_run(harness: Harness) -> None:
    with pytest.raises(RunError, match="coarse failed: WorkerCrashedError"):
        harness.drive(fails("coarse", DIED, 99))
    assert [f.final for f in harness.records(TaskFailed)] == [False, False, True]


def test_wrong_input_found_by_a_worker_ends_the_run_at_once(harness: Harness) -> None:
    with pytest.raises(InputError, match=r"a\.jpg is truncated"):
        harness.drive(fails("block/000", Failed("a.jpg is truncated", INPUT), 1))
    assert harness.records(RunEnded) == [RunEnded("failed", "a.jpg is truncated")]


def test_a_worker_that_ends_without_a_result_has_failed(harness: Harness) -> None:
    def script(name: str, fields: dict[str, Any]) -> Iterator[Event]:
        yield from well(name, fields) if name != "coarse" or len(harness.pool.started) > 1 else ()

    assert harness.drive(script).outcome == "done"
    assert harness.state.task("coarse").reasons == ("the worker ended without a result",)


def test_a_worker_that_dies_after_its_result_has_done_its_work(harness: Harness) -> None:
    def script(name: str, fields: dict[str, Any]) -> Iterator[Event]:
        yield from well(name, fields)
        if name != "eval":
            raise CrashError(DIED)

    assert harness.drive(script).outcome == "done"
    assert harness.names.count("coarse") == 1
    assert not harness.records(TaskFailed)
    assert not list(harness.folder.root.rglob("checkpoint.safetensors"))


def test_an_interrupted_run_says_so_and_goes_on(harness: Harness) -> None:
    def script(name: str, fields: dict[str, Any]) -> Iterator[Event]:
        if name == "block/000":
            raise KeyboardInterrupt
        yield from well(name, fields)

    with pytest.raises(KeyboardInterrupt):
        harness.drive(script)
    assert harness.state.outcome == "interrupted"
    assert harness.drive(resumed=True).outcome == "done"
    assert "coarse" not in harness.names


def test_without_refinement_the_model_is_stage_one(tmp_path: Path) -> None:
    harness = Harness(tmp_path, refine=False)
    harness.drive()
    assert harness.names == ["coarse", "eval"]
    assert harness.folder.point_cloud.read_bytes() == harness.folder.model("coarse").read_bytes()


def test_a_full_disk_is_a_failed_run_with_a_reason(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("panolog.orchestrator.driver.save", full)
    with pytest.raises(RunError, match="No space left on device"):
        harness.drive()
    assert [end.outcome for end in harness.records(RunEnded)] == ["failed"]


def test_a_checkpoint_that_a_kill_has_left_is_removed(harness: Harness) -> None:
    harness.drive()
    checkpoints = [harness.folder.checkpoint(task) for task in ("coarse", "block/000")]
    for path in checkpoints:
        path.touch()
    harness.drive(resumed=True)
    assert not any(path.exists() for path in checkpoints)
