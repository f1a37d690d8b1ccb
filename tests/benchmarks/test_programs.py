"""Each program that measures whole runs, small and to its end: what it must find on every machine."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest

from benchmarks.runs import history
from panolog.orchestrator.runs.records import ModelSaved, TaskStarted
from panolog.scene.colmap import write_colmap
from panolog.workers.tasks import Stage
from tests.deploy.files import ROOT
from tests.prepare.video.videos import HEIGHT, WIDTH, render, walk
from tests.ray_head import wait_until
from tests.scenes import write_scene

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]  # the longest takes four minutes alone
Found = dict[str, Any]


def chaos(found: Found, _: Path) -> None:
    undisturbed, disturbed = found["runs"]
    assert disturbed["faults"]
    assert disturbed["digest"] == undisturbed["digest"], disturbed["end"]


def paper(found: Found, folder: Path) -> None:
    results = {result["variant"]: result for result in found["results"]}
    assert list(results) == ["paper", "no-g2ps", "no-sky", "no-depth", "tau-0.7", "tau-0.8", "tau-0.9"]
    assert results["tau-0.8"]["same_as"] == "paper"
    curve = results["paper"]["curve"]
    assert curve == sorted(curve, key=lambda point: point["seconds"])
    assert {point["stage"] for point in curve} == {"coarse", "block", "merged"}
    assert results["no-sky"]["gaussians"] < results["paper"]["gaussians"]
    shared = {name for name, result in results.items() if "Stage I of paper" in result["notes"]}
    assert "no-g2ps" in shared | {name for name in results if results[name]["same_as"]}
    assert shared.isdisjoint({"paper", "no-sky", "no-depth"})
    records = [item.record for item in history(folder / "scene" / "paper@0")]
    blocks = [r for r in records if isinstance(r, TaskStarted | ModelSaved) and r.task.stage is Stage.BLOCK]
    assert [type(record) for record in blocks] == 2 * [TaskStarted, ModelSaved]  # one after another
    assert not list((folder / "scene").glob("*.states"))


def rasterizer(found: Found, folder: Path) -> None:
    assert {row["model"] for row in found["rows"]} == {"street"}
    assert "street" in (folder / "performance.md").read_text()


def driver(found: Found, _: Path) -> None:
    first, resumed = found["first"], found["resumed"]
    assert first["messages"] > 0 and resumed["messages"] > 0
    assert resumed["lost"] == 0
    assert 0 < resumed["full"] < resumed["seconds"]


def captures(found: Found, _: Path) -> None:
    (ours,) = found["results"]
    assert (ours["posed"], ours["panoramas"]) == (5, 5)
    assert ours["drift"] < 1.0


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A scene of noise, and a short street that poses can be found in."""
    root = tmp_path_factory.mktemp("scenes")
    noise = write_scene(root / "scene", names=[f"{i:02d}.jpg" for i in range(12)], points=500)
    street, poses = root / "street", []
    (street / "images").mkdir(parents=True)
    for number, shot in enumerate(walk([0.9] * 5)):
        cv2.imwrite(str(street / "images" / f"{number}.png"), render(shot))
        poses.append((f"{number}.png", np.eye(3), np.array([0.0, 0.0, -shot.along])))
    write_colmap(
        street / "sparse" / "0",
        poses,
        width=WIDTH,
        height=HEIGHT,
        points=np.random.default_rng(0).normal(size=(9, 3)),
        colors=np.zeros((9, 3), np.uint8),
        observations=[(np.empty(0, np.int64), np.empty((0, 2)))] * 5,
    )
    return {"scene": noise, "street": street}


PAPER = (
    "{scene} -o {folder} --tables ablations,tau --width 32 --iterations 16 --set sky.count=20 --device cpu"
)
PROGRAMS: list[tuple[Callable[[Found, Path], None], str, str]] = [
    (chaos, "chaos", "--runs 1 --seed 4 --faults driver,eio"),
    (paper, "paper", PAPER),
    (rasterizer, "rasterizer", "--quick -o {folder}/performance.md"),
    (driver, "driver", "--quick"),
    (captures, "places.captures", "{folder} --places --scene {street} --kinds photographs"),
]


@pytest.mark.parametrize(("check", "name", "options"), PROGRAMS, ids=[name for _, name, _ in PROGRAMS])
def test_a_program_measures(
    check: Callable[[Found, Path], None], name: str, options: str, tmp_path: Path, scenes: dict[str, Path]
) -> None:
    words = [word.format(folder=tmp_path, **scenes) for word in options.split()]
    command = [sys.executable, "-m", f"benchmarks.{name}", "--json", *words]
    ended = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert ended.returncode in (0, 1) and ended.stdout, ended.stderr  # 1: a goal of speed is missed
    check(json.loads(ended.stdout), tmp_path)


def test_chaos_that_is_stopped_leaves_no_process(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "benchmarks.chaos", "--folder", tmp_path], cwd=ROOT
    ) as process:
        program = psutil.Process(process.pid)

        def started() -> list[psutil.Process]:
            return [it for it in program.children(recursive=True) if it.name() == "raylet"]

        wait_until(lambda: len(started()) > 1, "both nodes have begun", 1800)
        below = program.children(recursive=True)
        process.terminate()
        assert process.wait(1800) == 143
    assert psutil.wait_procs(below, timeout=60)[1] == []
