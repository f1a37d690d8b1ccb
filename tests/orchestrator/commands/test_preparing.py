"""A run of panoramas makes its scene first: step by step, whatever stops it. A fake finds the poses."""

import json
import os
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copy, copytree
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.commands import session
from panolog.orchestrator.commands.supervise import progress_made
from panolog.orchestrator.preparation import notes
from panolog.orchestrator.preparation.settings import (
    Options,
    Settings,
    Step,
    as_arguments,
    parse_settings,
    read_settings,
)
from panolog.orchestrator.run import control
from panolog.orchestrator.run.config import load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import PENDING, read_info
from panolog.orchestrator.run.records import Noticed, Preparing
from panolog.orchestrator.run.state import ignore
from panolog.orchestrator.run.store import read_records
from panolog.prepare.check import scene_check
from panolog.prepare.sfm import pipeline
from panolog.prepare.sfm.pipeline import SfmSettings, WithMasks, panoramas_in_folder, workspace_folder
from panolog.scene.errors import InputError, SceneError
from panolog.scene.files import write_bytes
from panolog.scene.write import StageProgress
from panolog.synthetic.make import make_town
from tests.orchestrator.commands.test_session import CalibratingPool
from tests.scenes import write_scene

CONFIG = load_config(flags={"width": 64, "iterations": 2, "blocks": "2x1x1", "sky.count": 2})
REPORT = {
    "panoramas": 10,
    "registered": 9,
    "points": 300,
    "weak_links": [],
    "contradictions": [{"between": ["a", "b"]}],
}
Hook = Callable[[str], object]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("town") / "town", panoramas=9, width=64, points=300)


@pytest.fixture
def raw(town: Path, tmp_path: Path) -> Path:
    """The panoramas of the town without their poses."""
    copytree(town / "images", tmp_path / "raw")
    return tmp_path / "raw"


@dataclass
class Report:
    """What `make_scene` returns."""

    def lines(self) -> list[str]:
        return ["9 of 10 panoramas have a pose", "contradiction: a and b"]


@dataclass
class FakeSfm:
    """Finds the poses of the town's panoramas in two parts, each of which it keeps in its workspace."""

    town: Path
    at: Hook = ignore  # called with the name of each part before it is done, and of the report
    calls: list[SfmSettings] = field(default_factory=list)
    done: list[str] = field(default_factory=list)
    masks: list[list[tuple[str, int]]] = field(default_factory=list)  # of each call: name and time

    def make_scene(
        self,
        source: Path,
        output: Path,
        settings: SfmSettings,
        progress: StageProgress,
        with_masks: WithMasks,
    ) -> Report:
        self.calls.append(settings)
        work = workspace_folder(output.resolve())
        layers = with_masks(*panoramas_in_folder(source))
        found = [(mask.name, mask.stat().st_mtime_ns) for mask in layers.get("masks", []) if mask]
        self.masks.append(found)
        for part in ("features", "poses"):
            progress(part, 0, 10)
            self.at(part)
            if not (work / part).exists():
                work.mkdir(exist_ok=True)
                (work / part).touch()
                self.done.append(part)
            progress(part, 10, 10)
        copytree(self.town, output)
        for mask in filter(None, layers.get("masks", [])):
            (output / "masks").mkdir(exist_ok=True)
            copy(mask, output / "masks")
        self.at("report")
        write_bytes(output / "sfm.json", json.dumps(REPORT).encode())
        write_bytes(output / "sfm.png", bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1]))
        for file in work.iterdir():
            file.unlink()
        work.rmdir()
        return Report()


@pytest.fixture
def sfm(town: Path, monkeypatch: pytest.MonkeyPatch) -> FakeSfm:
    fake = FakeSfm(town)
    monkeypatch.setattr(pipeline, "make_scene", fake.make_scene)
    return fake


def start(source: Path, root: Path, *, action: Callable[[], object] = ignore, **options: Any) -> None:
    session.start(source, root, CONFIG, None, ignore, CalibratingPool(action), None, Options(**options))


def resume(root: Path) -> None:
    session.resume(root, None, ignore, CalibratingPool())


def call(*words: object) -> Any:
    return CliRunner().invoke(app.app, [str(word) for word in words])


class Killed(BaseException):
    """Ends a driver without a record, as far as a process can do that to itself."""


@pytest.fixture(scope="module")
def calm(town: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """An undisturbed run of the raw panoramas."""
    folder = tmp_path_factory.mktemp("calm")
    copytree(town / "images", folder / "raw")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "make_scene", FakeSfm(town).make_scene)
        start(folder / "raw", folder / "run")
    return RunFolder(folder / "run")


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
    assert notes.masks_picture(calm).read_bytes().startswith(b"\xff\xd8\xff")
    records = [stored.record for stored in read_records(calm.database)]
    steps = [str(it.task) for it in records if isinstance(it, Preparing)]
    assert steps == ["prepare"] * 3 + ["calibrate"] * 2
    noticed = [it.message for it in records if isinstance(it, Noticed) and str(it.task) == "prepare"]
    assert noticed[0] == "9 of 10 panoramas have a pose"
    assert noticed[1].startswith("without a pose: 1, contradictions: 1; ")
    done = json.loads(call("status", calm.root, "--json").stdout)
    assert [step["status"] for step in done["preparation"]["steps"]] == ["done"] * 3
    assert done["preparation"]["registered"] == 9


MOMENTS = ["features", "poses", "report", "masks", "check"]


@pytest.mark.parametrize("moment", MOMENTS)
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
    shown = json.loads(call("status", killed, "--json").stdout)
    assert (shown["status"], shown["stage"]) == ("stopped", "prepare")
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


def test_ctrl_c_in_the_preparation_is_resumed(
    calm: RunFolder, raw: Path, sfm: FakeSfm, tmp_path: Path
) -> None:
    def interrupt(at: str) -> None:
        if at == "poses":
            os.kill(os.getpid(), signal.SIGINT)

    sfm.at = interrupt
    with pytest.raises(KeyboardInterrupt):
        start(raw, tmp_path / "run")
    shown = json.loads(call("status", tmp_path / "run", "--json").stdout)
    assert (shown["status"], shown["stage"]) == ("interrupted", "prepare")
    sfm.at = ignore
    resume(tmp_path / "run")
    assert sfm.done == ["features", "poses"]
    assert RunFolder(tmp_path / "run").point_cloud.read_bytes() == calm.point_cloud.read_bytes()


def test_a_request_to_stop_is_taken_in_the_preparation(raw: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    root, waited = tmp_path / "run", threading.Event()

    def stop(at: str) -> None:
        if at == "poses":
            control.send(RunFolder(root), "stop")
            waited.wait(60)  # a signal ends it

    sfm.at = stop
    with pytest.raises(KeyboardInterrupt):
        start(raw, root)
    assert list(RunFolder(root).control.iterdir()) == []


def test_status_shows_how_far_the_preparation_is(raw: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    root, seen = tmp_path / "run", list[Any]()

    def look(at: str) -> None:
        if at == "poses":
            seen.append((call("status", root).stdout, json.loads(call("status", root, "--json").stdout)))

    sfm.at = look
    start(raw, root)
    ((text, shown),) = seen
    assert text.startswith("preparing: poses 0 of 10 · 0%")
    assert (shown["status"], shown["label"], shown["stage"]) == ("running", "preparing", "prepare")
    (masks, step, check) = shown["preparation"]["steps"]
    assert (step["status"], step["what"], step["done"], step["total"]) == ("running", "poses", 0, 10)
    assert (masks["status"], check["status"]) == ("done", "waiting")
    assert "masks: " in text
    assert call("pause", root, 0).exit_code == 2


def test_two_processes_cannot_prepare_one_run(raw: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    root, refused = tmp_path / "run", list[str]()

    def again(at: str) -> None:
        with pytest.raises(InputError) as started:
            start(raw, root)
        with pytest.raises(InputError) as resumed:
            resume(root)
        refused.extend([str(started.value), str(resumed.value)])
        sfm.at = ignore

    sfm.at = again
    start(raw, root)
    assert all("another driver is at work on it" in line for line in refused)
    assert len(refused) == 2


def fails(error: BaseException, moment: str = "poses") -> Hook:
    def fail(at: str) -> None:
        if at == moment:
            raise error

    return fail


def test_what_a_failed_reconstruction_has_kept_is_used_with_other_settings(
    raw: Path, sfm: FakeSfm, tmp_path: Path
) -> None:
    sfm.at = fails(SceneError("only 3 of 9 panoramas were connected; --partial"))
    for _ in range(2):
        with pytest.raises(SceneError, match="only 3 of 9"):
            start(raw, tmp_path / "run")
    sfm.at = ignore
    start(raw, tmp_path / "run", sfm={"partial": True, "distance": ("a", "b", 3.0)})
    assert sfm.done == ["features", "poses"]
    assert sfm.calls[-1] == SfmSettings(partial=True, distance=("a", "b", 3.0))
    with pytest.raises(InputError, match=r"holds this run; use `panolog resume "):
        start(raw, tmp_path / "run", sfm={"partial": True})


def test_a_preparation_that_fails_before_it_has_anything_leaves_no_trace(
    raw: Path, sfm: FakeSfm, tmp_path: Path
) -> None:
    sfm.at = fails(SceneError("parallax 90: give an angle"), "features")
    with pytest.raises(SceneError, match="parallax 90"):
        start(raw, tmp_path / "a" / "run", nadir=0, static=False)
    assert not (tmp_path / "a").exists()


def test_a_step_that_is_done_is_not_done_with_other_settings(raw: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    def refuse() -> None:
        raise InputError("does not fit")

    root = tmp_path / "run"
    with pytest.raises(InputError, match="does not fit"):
        start(raw, root, action=refuse)
    for options in ({"nadir": 20}, {"sfm": {"partial": True}}, {"nadir": 0, "static": False}):
        with pytest.raises(InputError, match="was done with other settings; repeat them, or choose another"):
            start(raw, root, **options)
    start(raw, root)
    assert len(sfm.calls) == 1


def test_a_scene_that_the_check_finds_wrong_is_not_trained(
    raw: Path, sfm: FakeSfm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = scene_check.check_scene

    def wrong(scene: Any) -> Any:
        return found(scene).__class__(
            **(vars(found(scene)) | {"problems": ("axes: y is up", "names: mixed")})
        )

    monkeypatch.setattr(scene_check, "check_scene", wrong)
    with pytest.raises(
        SceneError, match=r"axes: y is up \(and 1 more\); `panolog scene check .*` says more;"
    ) as caught:
        start(raw, tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert notes.read_result(RunFolder(tmp_path / "run"), Step.CHECK) is None


def test_masks_of_the_source_are_kept_as_they_are(town: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    source = tmp_path / "source"
    copytree(town / "images", source / "images")
    for image in (source / "images").iterdir():
        mask = np.full((32, 64), 255, np.uint8)
        (source / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(source / "masks" / f"{image.stem}.png"), mask)
    start(source, tmp_path / "run")
    settings = read_settings(RunFolder(tmp_path / "run"))
    assert settings is not None
    assert settings.steps() == (Step.SFM, Step.CHECK)


def test_masks_of_the_source_are_joined_with_what_is_wanted(town: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    source = tmp_path / "source"
    copytree(town / "images", source / "images")
    first = min((source / "images").iterdir())
    mask = np.full((32, 64), 255, np.uint8)
    mask[:, :8] = 0
    (source / "masks").mkdir()
    cv2.imwrite(str(source / "masks" / f"{first.stem}.png"), mask)
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


def test_a_scene_has_nothing_to_prepare(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    with pytest.raises(InputError, match="is a scene already; leave out the options"):
        start(scene, tmp_path / "run", nadir=5)


def test_another_source_or_a_scene_does_not_take_the_folder(
    raw: Path, sfm: FakeSfm, town: Path, tmp_path: Path
) -> None:
    sfm.at = fails(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        start(raw, tmp_path / "run")
    copytree(raw, tmp_path / "other")
    with pytest.raises(InputError, match=f"belongs to a run of {raw}; choose another folder"):
        start(tmp_path / "other", tmp_path / "run")
    with pytest.raises(InputError, match="belongs to a run that makes its scene itself"):
        start(town, tmp_path / "run")


def image(path: Path, width: int, height: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((height, width, 3), np.uint8))


def test_wrong_input_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    root = tmp_path / "run"
    image(tmp_path / "one" / "a.jpg", 64, 32)
    image(tmp_path / "flat" / "a.jpg", 64, 40)
    image(tmp_path / "flat" / "b.jpg", 64, 40)
    image(tmp_path / "sizes" / "a.jpg", 64, 32)
    image(tmp_path / "sizes" / "b.jpg", 128, 64)
    (tmp_path / "none").mkdir()
    (tmp_path / "text.mp4").write_text("no video")
    writer = cv2.VideoWriter(str(tmp_path / "flat.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    writer.write(np.zeros((240, 320, 3), np.uint8))
    writer.release()
    wrong = {
        "one": "1 panoramas .*; at least 2 are needed",
        "flat": "64 x 40 pixels are not 2:1",
        "sizes": "all panoramas must have one size",
        "none": "there is no",
        "missing": "there is no such folder",
        "text.mp4": "cannot be opened as a video|no video",
        "flat.avi": "are not 2:1",
    }
    for name, message in wrong.items():
        ended = call("run", tmp_path / name, "-o", root)
        assert ended.exit_code == 2, (name, ended.output)
        lines = [line for line in ended.stderr.splitlines() if line.startswith("panolog: ")]
        assert len(lines) == 1, ended.stderr
        with pytest.raises(InputError, match=message):
            start(tmp_path / name, root)
        assert not root.exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    image(tmp_path / "two" / "a.jpg", 64, 32)
    image(tmp_path / "two" / "b.jpg", 64, 32)
    ended = call("run", tmp_path / "two", "-o", tmp_path / "full")
    assert ended.exit_code == 2
    assert "is not empty and not a run" in ended.stderr
    ended = call("run", tmp_path / "two", "-o", root, "--depth-model", tmp_path / "no.onnx")
    assert (ended.exit_code, "there is no such model" in ended.stderr) == (2, True)
    ended = call("run", tmp_path / "two", "-o", root, "--width", 128)
    assert (ended.exit_code, "the panoramas have 64 pixels" in ended.stderr) == (2, True)
    assert not root.exists()


def test_options_survive_the_way_through_a_command_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = Options(
        sfm={"parallax": 3.5, "frames": 40, "distance": ("a b", "c", 2.5), "gps": False, "partial": True},
        nadir=7.5,
        static=False,
        depth_model="m.onnx",
    )
    seen = list[Options]()

    def start_nothing(*arguments: Any) -> None:
        seen.append(arguments[-1])
        raise InputError("seen")

    monkeypatch.setattr(session, "start", start_nothing)
    call("run", tmp_path, "-o", tmp_path / "run", *as_arguments(given))
    assert seen == [given]
    assert not Options().given
    assert list(as_arguments(Options())) == []


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{", b'{"format": 2}', b"[" * 100_000, b'{"nadir": 1e999}', b" " * 2_000_000]
)
def test_files_of_the_preparation_that_are_none_are_not_believed(content: bytes, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.preparation.mkdir()
    assert parse_settings(content) is None
    for path in (notes.progress_path(folder), notes.result_path(folder, Step.SFM)):
        path.write_bytes(content)
    assert notes.read_progress(folder) is None
    assert notes.read_result(folder, Step.SFM) is None


def test_long_results_are_shortened() -> None:
    lines = notes.shortened(["x" * 600, *("y" for _ in range(200))])
    assert len(lines) == 100
    assert len(lines[0]) == 500
    assert lines[-1] == "… and 102 more lines"


def test_a_step_that_is_done_counts_as_progress_of_a_supervised_run(calm: RunFolder, tmp_path: Path) -> None:
    assert progress_made(calm.root) != progress_made(tmp_path)


def test_settings_are_those_of_the_step(tmp_path: Path) -> None:
    settings = Settings(source="a", video=False, panoramas=3, width=64, nadir=0, static=False)
    assert settings.steps() == (Step.SFM, Step.CHECK)
    with_depth = settings.model_copy(update={"depth_model": "m.onnx", "nadir": 3.0})
    assert with_depth.steps() == tuple(Step)
    assert with_depth.of(Step.SFM) == settings.of(Step.SFM)
    assert with_depth.of(Step.MASKS) != settings.of(Step.MASKS)
