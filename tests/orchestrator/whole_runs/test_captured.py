"""A run that learns exposures, poses and movers, interrupted in both stages."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.engine.driver.local_pool import local_pool
from panolog.orchestrator.runs import control
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.control import Action
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import CheckpointSaved, Stored, TaskStarted, TaskYielded
from panolog.orchestrator.runs.state import OnChange, RunState, ignore
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE, TaskId
from tests.scenes import copy_scene

pytestmark = pytest.mark.system

WIDTH, BLOCK = 128, TaskId.block(0)
CONFIG = load_config(
    sets=(
        *("iterations=100", "sky.count=100", "checkpoint.every=20", "checkpoint.share=1", "device=cpu"),
        *("densify.start=10", "densify.every_floor=5", "exposure.learn=true", "exposure.begin=0.1"),
        *("poses.refine=true", "poses.begin=0.1", "poses.visits=0"),
        *("movers.weigh=true", "movers.factor=1.2"),
    )
)
INTERRUPTED = (COARSE, BLOCK)


def write_walk(folder: Path) -> Path:
    """A street whose panoramas differ in exposure, and one of which shows someone whom no other does."""
    street = read_scene(make_town(folder / "town", panoramas=9, width=WIDTH, points=1500))

    def taken(name: str, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        number = int(Path(name).stem[-3:])
        if number == 3:
            cv2.rectangle(picture, (60, 26), (66, 44), (200, 20, 220), -1)
        gain = 2 ** (0.5 * np.sin(2.0 * number) / 2.4)
        return np.asarray(np.clip(picture * gain + 14 * (gain - 1), 0, 255).round(), np.uint8)

    copy_scene(street, folder / "walk", taken)
    return folder / "walk"


def interrupt(folder: RunFolder, task: TaskId) -> OnChange:
    """Ends a driver at the first checkpoint of a task.

    In Stage I by a request to stop, so that its worker saves a last checkpoint wherever it is; then by force.
    """
    begun = list[TaskId]()

    def show(_: RunState, news: Sequence[Stored]) -> None:
        if begun or not any(isinstance(it.record, CheckpointSaved) and it.record.task == task for it in news):
            return
        begun.append(task)
        if task != COARSE:
            raise KeyboardInterrupt
        control.send(folder, Action.STOP)

    return show


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, RunFolder]:
    """An undisturbed run, and one that was interrupted again and again."""
    folder = tmp_path_factory.mktemp("captured")
    scene, calm, disturbed = write_walk(folder), RunFolder(folder / "calm"), RunFolder(folder / "disturbed")
    with local_pool() as pool:
        session.start(scene, calm.root, CONFIG, None, ignore, pool)
    for number, task in enumerate(INTERRUPTED):
        show = interrupt(disturbed, task)
        with local_pool() as pool, pytest.raises(KeyboardInterrupt):
            if number:
                session.resume(disturbed.root, None, show, pool)
            else:
                session.start(scene, disturbed.root, CONFIG, None, show, pool)
    with local_pool() as pool:
        assert session.resume(disturbed.root, None, ignore, pool).outcome == "done"
    return calm, disturbed


def files_of(folder: RunFolder) -> dict[str, bytes]:
    learnt = [folder.measured, folder.captured(COARSE), folder.exposure, folder.poses, folder.mover_shares]
    models = [folder.point_cloud, folder.model(COARSE), folder.model(BLOCK), folder.plan]
    found = [*learnt, *models, folder.metrics, folder.seams]
    for place in (folder.movers, folder.sparse, folder.images):
        found += [path for path in sorted(place.rglob("*")) if path.is_file()]
    return {path.relative_to(folder.root).as_posix(): path.read_bytes() for path in found}


def test_what_was_interrupted_everywhere_ends_with_the_same_bytes(runs: tuple[RunFolder, RunFolder]) -> None:
    calm, disturbed = runs
    records = [stored.record for stored in read_records(disturbed.database)]
    attempts = [record.task for record in records if isinstance(record, TaskStarted)]
    assert all(attempts.count(task) == 2 for task in INTERRUPTED)
    assert TaskYielded(COARSE) in records
    ours, theirs = files_of(disturbed), files_of(calm)
    assert [name for name in theirs if ours[name] != theirs[name]] == []
    assert not list(disturbed.root.rglob("*.part"))


def test_all_three_were_learnt(runs: tuple[RunFolder, RunFolder]) -> None:
    folder, _ = runs
    stops = {each["name"]: each["stops"] for each in json.loads(folder.exposure.read_text())["panoramas"]}
    assert np.std(list(stops.values())) > 0.1
    moves = json.loads(folder.poses.read_text())["panoramas"]
    assert all(each["pixels"] > 0 for each in moves)
    shares = {e["name"]: e["share"] for e in json.loads(folder.mover_shares.read_text())["panoramas"]}
    assert shares["street_003.png"] > 0
    fitted = json.loads(folder.metrics.read_text())["pose_fit"]
    assert set(fitted["views"]) == {"street_000.png", "street_008.png"}
