"""Each program that measures whole runs, small and to its end: what it must find on every machine."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks.three_days.faults import Fault
from tests.deploy.files import ROOT

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]  # the longest takes four minutes alone
Found = dict[str, Any]


def chaos(found: Found) -> None:
    undisturbed, disturbed = found["runs"]
    assert disturbed["costs"]
    assert disturbed["digest"] == undisturbed["digest"], disturbed["end"]


def notices(found: Found) -> None:
    calm, moved = (run for run in found["runs"] if run["nodes"] == 3)
    assert moved["digest"] == calm["digest"], moved["end"]
    assert moved["cost"]["redone"] == 0
    assert moved["cost"]["checkpoint"] is not None


def contention(found: Found) -> None:
    assert [phase["taken"] for phase in found["phases"]][:2] == [0, 1]
    assert all(rate > 0 for phase in found["phases"] for rate in phase["rates"])


def cuda_resources(found: Found) -> None:
    names = {kernel["name"] for kernel in found["kernels"]}
    assert {"project_forward", "composite_backward", "loss_gradient", "adam_step"} <= names


def dashboard(found: Found) -> None:
    measured = found["report"]
    assert min(measured["warm"], *measured["alone"], *measured["among"]) > 0


def driver_scale(found: Found) -> None:
    measured = found["report"]
    assert measured["events"] >= 12 * 8
    assert measured["lost"] == 0
    assert set(measured["status"]) == {"function", "command"}
    assert all(times["median"] > 0 for times in measured["status"].values())


def merge_scale(found: Found) -> None:
    assert [turn["name"] for turn in found["turns"]] == ["cat", "merge", "cat"]
    assert 0 < found["turns"][1]["before"] <= found["turns"][1]["peak"]


def overhead(found: Found) -> None:
    first, plain, _ = found["turns"]
    # Each of two blocks saves twice, but not before the driver has taken its last file: so it may be once.
    assert first["checkpoints"] in (2, 3, 4) and plain["checkpoints"] == 0
    assert set(first["digests"]) == {"block/000", "block/001"}
    assert first["digests"] == plain["digests"]
    assert all(turn["seconds"] > turn["training"] > 0 for turn in found["turns"])


def saving(found: Found) -> None:
    assert [one["writers"] for one in found["measured"]] == [1, 2, 4]
    assert all(one["most"] <= one["writers"] for one in found["measured"])


def scale(found: Found) -> None:
    first, resumed = found["driver"]["first"], found["driver"]["resumed"]
    assert first["messages"] > 0 and resumed["messages"] > 0
    assert resumed["lost"] == 0
    assert 0 < resumed["full"] < resumed["seconds"]
    assert [row["gaussians"] for row in found["merge"]] == [1000, 2000]
    assert all(0 < row["starts"] <= row["gaussians"] for row in found["levels"])
    for row in found["cities"]["cities"]:
        assert set(row["stages"]) == {"coarse", "score", "block", "repair", "measure"}
        assert all(task["memory"] > 2**20 and task["seconds"] > 0 for task in row["stages"].values())
    assert found["cities"]["cities"][1]["stages"]["coarse"]["count"] == 7  # of at most 12 of 21 panoramas


def three_days(found: Found) -> None:
    assert found["problems"] == []
    assert [bound for bound in found["bounds"] if not bound["met"] and not bound["timed"]] == []
    assert (found["faults"]["driver killed"], found["faults"]["driver stopped"]) == (3, 1)
    assert all(found["faults"][kind.value] for kind in (Fault.NODE_LOST, Fault.BAD_NODE))
    assert found["samples"][-1]["done"] > found["load"]["blocks"]


PARTS = "cities,driver,dashboard,merge,levels"
PROGRAMS: list[tuple[Callable[[Found], None], str, tuple[str, ...]]] = [
    (chaos, "chaos", ("--runs", "1", "--seed", "4", "--faults", "driver,eio")),
    (notices, "chaos.notices", ("--runs", "1", "--seconds", "120", "--nodes", "3")),
    (contention, "contention", ("--quick",)),
    (cuda_resources, "cuda_resources", ("--arch", "sm_89")),
    (dashboard, "dashboard", ("--quick",)),
    (driver_scale, "driver_scale", ("--quick", "--folder", "{folder}")),
    (merge_scale, "merge_scale", ("--quick", "--folder", "{folder}")),
    (overhead, "overhead", ("--quick", "--folder", "{folder}")),
    (saving, "saving", ("--quick", "--folder", "{folder}")),
    (scale, "scale", ("--quick", "-o", "{folder}", "--only", PARTS)),
    (three_days, "three_days", ("--quick", "--folder", "{folder}", "--plot", "{folder}/curves.svg")),
]


@pytest.mark.parametrize(("check", "name", "options"), PROGRAMS, ids=[name for _, name, _ in PROGRAMS])
def test_a_program_measures(
    check: Callable[[Found], None], name: str, options: tuple[str, ...], tmp_path: Path
) -> None:
    words = [option.format(folder=tmp_path) for option in options]
    command = [sys.executable, "-m", f"benchmarks.{name}", "--json", *words]
    ended = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    assert ended.returncode in (0, 1) and ended.stdout, ended.stderr  # 1: a goal of speed is missed
    check(json.loads(ended.stdout))
    if name == "three_days":
        assert (tmp_path / "curves.svg").stat().st_size > 10_000
        assert [path.name for path in tmp_path.iterdir()] == ["curves.svg"]
