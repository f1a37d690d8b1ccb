"""A run that learns exposures, poses and movers, killed in Stage I, in Stage II and in the evaluation."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.captures.copies import copy_scene
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import TaskStarted
from panolog.orchestrator.run.store import read_records
from panolog.scene.read import read_scene
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.whole_runs.test_whole_runs import (
    SETTINGS,
    Accident,
    Ended,
    end_of,
    launch,
    state_of,
    wait_for_workers,
)

pytestmark = pytest.mark.system

WIDTH = 128
LEARNING = ("exposure.learn=true", "poses.refine=true", "movers.weigh=true")
EARLY = ("iterations=100", "exposure.begin=0.1", "poses.begin=0.1", "poses.visits=0", "movers.factor=1.2")
OPTIONS = (*SETTINGS, *(word for setting in (*LEARNING, *EARLY) for word in ("--set", setting)))
BLOCK = TaskId.block(0)
KILLED: list[list[Accident]] = [  # of a driver after the other
    [("CheckpointSaved", str(COARSE), "worker", 9), ("CheckpointSaved", str(COARSE), "driver", 9)],
    [("CheckpointSaved", str(COARSE), "driver", 9)],
    [("CheckpointSaved", str(BLOCK), "worker", 9), ("CheckpointSaved", str(BLOCK), "driver", 9)],
    [("ViewEvaluated", str(EVAL), "worker", 9), ("ViewEvaluated", str(EVAL), "driver", 9)],
]


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


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended, Path]:
    """An undisturbed run, how it ended, and the folder of one that was killed again and again."""
    folder = tmp_path_factory.mktemp("captured")
    scene, calm, killed = write_walk(folder), folder / "calm", folder / "killed"
    undisturbed = launch("run", scene, "-o", calm, *OPTIONS)
    for number, accidents in enumerate(KILLED):
        command = ("resume", killed) if number else ("run", scene, "-o", killed, *OPTIONS)
        end = end_of(launch(*command, accidents=accidents))
        assert end.code == -9, end.stderr
        wait_for_workers(killed)
    end = end_of(launch("resume", killed))
    assert end.code == 0, end.stderr
    return calm, end_of(undisturbed), killed


def files_of(root: Path) -> dict[str, bytes]:
    """What a run has made of its scene and learnt, besides times and places."""
    folder = RunFolder(root)
    learnt = [folder.measured, folder.captured(COARSE), folder.exposure, folder.poses, folder.mover_shares]
    models = [folder.point_cloud, folder.model(COARSE), folder.model(BLOCK), folder.plan]
    found = [*learnt, *models, folder.metrics, folder.seams]
    for place in (folder.movers, folder.sparse, folder.images):
        found += [path for path in sorted(place.rglob("*")) if path.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in found}


def test_what_was_killed_everywhere_ends_with_the_same_bytes(runs: tuple[Path, Ended, Path]) -> None:
    calm, end, killed = runs
    assert (end.code, end.stdout) == (0, ""), end.stderr
    assert "Traceback" not in end.stderr
    attempts = [
        s.record.task for s in read_records(RunFolder(killed).database) if isinstance(s.record, TaskStarted)
    ]
    assert all(attempts.count(task) >= 3 for task in (COARSE, BLOCK, EVAL))
    ours, theirs = files_of(killed), files_of(calm)
    assert [name for name in theirs if ours[name] != theirs[name]] == []
    assert not list(killed.rglob("*.part"))


def test_all_three_were_learnt(runs: tuple[Path, Ended, Path]) -> None:
    folder = RunFolder(runs[0])
    stops = {each["name"]: each["stops"] for each in json.loads(folder.exposure.read_text())["panoramas"]}
    assert np.std(list(stops.values())) > 0.1
    moves = json.loads(folder.poses.read_text())["panoramas"]
    assert all(each["pixels"] > 0 for each in moves)
    shares = {e["name"]: e["share"] for e in json.loads(folder.mover_shares.read_text())["panoramas"]}
    assert shares["street_003.png"] > 0
    fitted = json.loads(folder.metrics.read_text())["pose_fit"]
    assert set(fitted["views"]) == {"street_000.png", "street_008.png"}
    assert state_of(runs[2]).outcome == "done"
