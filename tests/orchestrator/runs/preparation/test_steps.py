"""A run of panoramas makes its scene first: step by step, whatever stops it."""

import json
import os
import re
import signal
import threading
from pathlib import Path
from shutil import copytree
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.orchestrator.cli.session import scene_making, session
from panolog.orchestrator.engine.driver import purse
from panolog.orchestrator.runs import control
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import PENDING, read_info
from panolog.orchestrator.runs.money.limits import Wanted
from panolog.orchestrator.runs.money.prices import MachinePrice, PriceList
from panolog.orchestrator.runs.money.records import BudgetSet
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.settings import Options, Step, read_settings
from panolog.orchestrator.runs.records import Noticed, Preparing
from panolog.orchestrator.runs.state import ignore
from panolog.orchestrator.watch.dashboard.api import encoded_map
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.prepare.sfm.pipeline import workspace_folder
from panolog.scene.errors import ConfigError, InputError
from panolog.scene.read import read_scene
from tests.orchestrator.cli.program import call, shown
from tests.orchestrator.cli.session.test_session import calibrating
from tests.orchestrator.runs.preparation.fake_sfm import CONFIG, FakeSfm, Killed, resume, start
from tests.prepare.networks.networks import given, red_depth

pytestmark = pytest.mark.system

KILLED_AT = ("masks", "poses", "check")  # the first step, the one with work of its own to keep, the last one
OTHERS = [pytest.param(moment, marks=pytest.mark.nightly) for moment in ("features", "report")]


def test_a_folder_of_panoramas_becomes_a_scene_and_a_model(calm: RunFolder) -> None:
    assert calm.point_cloud.exists()
    info = read_info(calm)
    assert info.scene.path == str(calm.scene.resolve())
    assert info.scene.fingerprint != PENDING
    settings = read_settings(calm)
    assert settings is not None
    assert settings.steps() == (Step.MASKS, Step.SFM, Step.CHECK)
    assert (settings.nadir, settings.static, settings.panoramas, settings.width) == (10, True, 9, 64)
    assert len(list((calm.scene / "masks").iterdir())) == 9
    assert calm.masks_picture.read_bytes().startswith(b"\xff\xd8\xff")
    records = [stored.record for stored in read_records(calm.database)]
    steps = [str(it.task) for it in records if isinstance(it, Preparing)]
    assert steps == ["prepare"] * 3 + ["calibrate"] * 4
    noticed = [it.message for it in records if isinstance(it, Noticed) and str(it.task) == "prepare"]
    assert noticed[0] == "9 of 10 panoramas have a pose"
    assert noticed[1].startswith("without a pose: 1, contradictions: 1; ")
    assert noticed[2] == "2 files (a.heic, b.heic): left out, each HEIC"
    done = shown("status", calm.root)
    assert [step["status"] for step in done["preparation"]["steps"]] == ["done"] * 3
    assert done["preparation"]["registered"] == 9


@pytest.mark.parametrize("moment", [*KILLED_AT, *OTHERS])
def test_a_run_killed_in_a_step_ends_with_the_same_bytes(
    moment: str, calm: RunFolder, raw: Path, sfm: FakeSfm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is on the disk at that moment is copied, and resumed in the copy."""
    root, killed = tmp_path / "run", tmp_path / "killed"

    def strike(at: str) -> None:
        if at == moment:
            copytree(root, killed)
            raise Killed

    sfm.at = strike
    write = notes.write_note

    def written(path: Path, note: Any) -> None:
        strike(path.stem)
        write(path, note)

    monkeypatch.setattr(notes, "write_note", written)
    with pytest.raises(Killed):
        start(raw, root)
    assert RunFolder(killed).info.exists()
    status = shown("status", killed)
    assert (status["status"], status["stage"]) == ("stopped", "prepare")
    monkeypatch.setattr(notes, "write_note", write)
    sfm.at, sfm.done = ignore, []
    resume(killed)
    assert ("features" in sfm.done) == (moment in ("features", "masks"))
    assert all(masks == sfm.masks[0] for masks in sfm.masks)  # else features would be found again
    same = RunFolder(killed)
    assert same.point_cloud.read_bytes() == calm.point_cloud.read_bytes()
    for mask in (calm.scene / "masks").iterdir():
        assert (same.scene / "masks" / mask.name).read_bytes() == mask.read_bytes()
    assert not list(killed.rglob("*.part"))
    assert not workspace_folder(same.scene.resolve()).exists()


@pytest.mark.parametrize("how", ["Ctrl-C", "panolog stop"])
def test_a_stop_in_the_preparation_is_resumed(
    how: str, calm: RunFolder, raw: Path, sfm: FakeSfm, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path / "run")

    def stop(at: str) -> None:
        if at == "poses" and how == "Ctrl-C":
            os.kill(os.getpid(), signal.SIGINT)
        elif at == "poses":
            control.send(folder, "stop")
            threading.Event().wait(300)  # a signal ends it

    sfm.at = stop
    with pytest.raises(KeyboardInterrupt):
        start(raw, folder.root)
    assert list(folder.control.iterdir()) == []
    status = shown("status", folder.root)
    assert (status["status"], status["stage"]) == ("interrupted", "prepare")
    sfm.at = ignore
    resume(folder.root)
    assert sfm.done == ["features", "poses"]
    assert folder.point_cloud.read_bytes() == calm.point_cloud.read_bytes()


def test_a_limit_of_cost_counts_the_making_of_the_scene(
    raw: Path, sfm: FakeSfm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = purse.require_left  # once something is made: else nothing would be left of the run
    monkeypatch.setattr(scene_making, "require_left", lambda *known: sfm.done and look(*known))
    prices = PriceList(currency="USD", machine=(MachinePrice(name="any", price=1e9, host="*"),))
    folder, work = RunFolder(tmp_path / "run"), (ignore, calibrating(), None)
    with pytest.raises(ConfigError, match=r"the limit of 1e-06 USD is reached before there is a scene"):
        session.start(raw, folder.root, CONFIG, None, *work, Options(), Wanted(1e-6, None, prices))
    made = shown("status", folder.root)
    assert (made["status"], made["stage"]) == ("failed", "prepare")
    assert made["money"]["used"]["cost"] > 1e-6
    with pytest.raises(ConfigError, match=r"--max-cost 1e-06: .*are used; give more"):
        purse.require_enough({}, BudgetSet(max_cost=1e-6, prices={"currency": "USD"}), [], 0.0, used=1e-6)
    session.resume(folder.root, None, *work, wanted=Wanted(removed=frozenset({"max_cost"})))
    assert folder.point_cloud.exists()
    assert shown("status", folder.root)["money"]["used"]["cost"] > made["money"]["used"]["cost"]


def test_status_and_map_show_how_far_the_preparation_is_and_no_other_process_joins(
    raw: Path, sfm: FakeSfm, tmp_path: Path
) -> None:
    """On the map GPS comes first, then the panoramas that have a pose, and at last those that train."""
    maps, entry = list[dict[str, Any]](), RunEntry(tmp_path, "run")
    root, folder, seen = tmp_path / "run", entry.folder, list[Any]()

    def look(at: str) -> None:
        if at in ("features", "poses", "check"):
            figure = json.loads(encoded_map(folder))
            traces = {trace["name"]: trace for trace in figure["data"]}
            maps.append(traces | {"names": figure["blocks"]["names"]})
        if at == "poses":
            seen.append((call("status", root).stdout, shown("status", root)))
            with pytest.raises(InputError, match="another driver is at work on it"):
                start(raw, root)
            with pytest.raises(InputError, match="another driver is at work on it"):
                resume(root)

    sfm.at = look
    start(raw, root, action=lambda: look("check"))
    ((text, status),) = seen
    over = status["preparation"]["over"]
    shown_first = re.match(r"preparing: poses 0 of 10 · (\d+)% ", text)
    assert shown_first and 0 < int(shown_first[1]) <= round(100 * over)  # the share grows meanwhile
    assert 0 < over == status["progress"] < status["preparation"]["progress"] < 1
    assert "masks: " in text
    assert (status["status"], status["label"], status["stage"]) == ("running", "preparing", "prepare")
    (masks, step, check) = status["preparation"]["steps"]
    assert (step["status"], step["what"], step["done"], step["total"]) == ("running", "poses", 0, 10)
    assert (masks["status"], check["status"]) == ("done", "waiting")
    assert call("pause", root, 0).exit_code == 2
    found = [(len(it["fixes"]["x"]), len(it["cameras"]["x"]), len(it["names"])) for it in maps]
    assert found == [(9, 0, 0), (0, 5, 5), (0, 7, 7)]  # of nine panoramas two are held out
    scene = read_scene(folder.scene)
    np.testing.assert_allclose(maps[2]["cameras"]["x"], scene.centers[list(scene.train), 0])


def with_masks(town: Path, source: Path, count: int) -> Path:
    """Panoramas of the town, the first ones with masks of a strip on the left."""
    copytree(town / "images", source / "images")
    (source / "masks").mkdir()
    mask = np.full((32, 64), 255, np.uint8)
    mask[:, :8] = 0
    for image in sorted((source / "images").iterdir())[:count]:
        cv2.imwrite(str(source / "masks" / f"{image.stem}.png"), mask)
    return source


def test_masks_of_the_source_are_joined_with_what_is_wanted(town: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    def kill(at: str) -> None:
        if at == "features":
            (source / "masks" / f"{images[1].stem}.png").unlink()  # which does not count any more
            raise Killed

    source, sfm.at = with_masks(town, tmp_path / "source", 2), kill
    images = sorted((source / "images").iterdir())
    with pytest.raises(Killed):
        start(source, tmp_path / "run", nadir=45)
    sfm.at = ignore
    start(source, tmp_path / "run", nadir=45)
    made = tmp_path / "run" / "scene" / "masks"
    assert len(list(made.iterdir())) == 9
    joined, other = (cv2.imread(str(it), cv2.IMREAD_GRAYSCALE) for it in sorted(made.iterdir())[:2])
    assert joined is not None
    assert other is not None
    assert joined[0, :8].max() == 0
    assert joined[-1].max() == other[-1].max() == 0
    assert joined[0, 8:].min() == other[0].min() == 255
    assert {it.name for it in (tmp_path / "run" / "prepare").iterdir() if it.is_dir()} == set()


def test_depth_is_estimated_if_a_network_is_given(raw: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    head = {"output": "depth", "kind": "inverse", "distance": "radial"}
    model = red_depth(tmp_path, {"task": "depth", "input": given(), "depth": head})
    start(raw, tmp_path / "run", depth_model=str(model))
    folder = RunFolder(tmp_path / "run")
    result = notes.read_result(folder, Step.DEPTH)
    assert result is not None
    assert result.settings == {"model": str(model)}
    assert len(list((folder.scene / "depths").iterdir())) == 9
    assert all(panorama.depth is not None for panorama in read_scene(folder.scene).panoramas)
    assert folder.point_cloud.exists()
