"""What a run of panoramas refuses, in one line, and what it keeps then."""

import re
from pathlib import Path
from shutil import copytree
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.settings import (
    Options,
    Step,
    as_arguments,
    read_settings,
)
from panolog.orchestrator.runs.state import ignore
from panolog.prepare.check import scene_check
from panolog.prepare.sfm.pipeline import SfmSettings
from panolog.scene.errors import InputError, SceneError
from tests.orchestrator.cli.program import call, one_line, shown
from tests.orchestrator.runs.preparation.fake_sfm import FakeSfm, fails, image, start
from tests.prepare.networks.networks import given, red_depth
from tests.scenes import write_scene

pytestmark = pytest.mark.system


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


def test_a_trajectory_is_read_before_anything_is_done(
    raw: Path, sfm: FakeSfm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=r"walk\.tum: there is no such file"):
        start(raw, tmp_path / "run", sfm={"trajectory": "walk.tum"})
    assert not (tmp_path / "run").exists() and not sfm.calls
    (tmp_path / "walk.tum").write_text("".join(f"{t} {t} 0 0 0 0 0 1\n" for t in range(9)))
    start(raw, tmp_path / "run", sfm={"trajectory": "walk.tum"})
    assert sfm.calls == [SfmSettings(trajectory=tmp_path / "walk.tum")]


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


def test_wrong_input_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    root = tmp_path / "run"
    image(tmp_path / "one" / "a.jpg", 64, 32)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        image(tmp_path / "flat" / name, 64, 40)
        image(tmp_path / "sizes" / name, *((512, 256) if name == "b.jpg" else (64, 32)))
    (tmp_path / "none").mkdir()
    (tmp_path / "text.mp4").write_text("no video")
    writer = cv2.VideoWriter(str(tmp_path / "flat.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    writer.write(np.zeros((240, 320, 3), np.uint8))
    writer.release()
    for name in ("a.png", "b.png", "c.png"):
        circles = np.full((128, 256), 90, np.uint8)
        circles[np.hypot(*(np.mgrid[:128, :256] % 128 - 63.5)) > 64] = 0
        (tmp_path / "fisheye").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "fisheye" / name), circles)
    wrong = {
        "fisheye": "a.png: its two fisheye circles cannot be stitched: .*; or stitch it in",
        "one": "1 panoramas .*; at least 3 are needed",
        "flat": "64 x 40 pixels are not 2:1",
        "sizes": "a.jpg: is 64 pixels wide, and b.jpg 512, more than 4 times as many",
        "none": "the folder is empty",
        "missing": "there is no such file or folder",
        "text.mp4": "cannot be opened as a video|no video",
        "flat.avi": "are not 2:1",
    }
    for name, message in wrong.items():
        assert re.search(message, one_line(call("run", tmp_path / name, "-o", root))), name
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    image(tmp_path / "three" / "a.jpg", 64, 32)
    image(tmp_path / "three" / "b.jpg", 64, 32)
    image(tmp_path / "three" / "c.jpg", 64, 32)
    run = ("run", tmp_path / "three", "-o")
    assert "is not empty and not a run" in one_line(call(*run, tmp_path / "full"))
    for network in ("--mask-model", "--depth-model"):
        assert "there is no such model" in one_line(call(*run, root, network, tmp_path / "no.onnx"))
    assert "the panoramas have 64 pixels" in one_line(call(*run, root, "--width", 128))
    assert not root.exists()


def test_sources_and_options_survive_the_way_through_a_command_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = Options(
        sfm={
            **{"parallax": 3.5, "frames": 40, "distance": ("a b", "c", 2.5), "trajectory": "my walk.tum"},
            **{"gps": False, "partial": True},
        },
        nadir=7.5,
        static=False,
        mask_model="people.onnx",
        depth_model="m.onnx",
    )
    seen = list[Any]()

    def start_nothing(*arguments: Any) -> None:
        seen.extend([arguments[0], *(it for it in arguments if isinstance(it, Options))])
        raise InputError("seen")

    monkeypatch.setattr(session, "start", start_nothing)
    call("run", tmp_path / "a.mp4", "b", "-o", tmp_path / "run", tmp_path / "c.mp4", *as_arguments(given))
    assert seen == [[f"{tmp_path}/a.mp4", "b", f"{tmp_path}/c.mp4"], given]
    assert not Options().given
    assert list(as_arguments(Options())) == []


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{", b'{"format": 2}', b"[" * 100_000, b'{"nadir": 1e999}', b" " * 2_000_000]
)
def test_files_of_the_preparation_that_are_none_are_not_believed(content: bytes, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.preparation.mkdir()
    folder.preparation_settings.write_bytes(content)
    with pytest.raises(InputError, match=r"settings\.json"):
        read_settings(folder)
    for path in (folder.preparation_progress, folder.step_result(Step.SFM)):
        path.write_bytes(content)
    assert notes.read_progress(folder) is None
    assert notes.read_result(folder, Step.SFM) is None
    of_another = notes.StepResult(step=Step.MASKS, settings={}, seconds=1, lines=())
    notes.write_note(folder.step_result(Step.SFM), of_another)
    assert notes.read_result(folder, Step.SFM) is None


def test_long_results_are_shortened() -> None:
    lines = notes.shortened(["x" * 600, *("y" for _ in range(200))])
    assert len(lines) == 100
    assert len(lines[0]) == 500
    assert lines[-1] == "… and 102 more lines"


def test_doctor_says_of_panoramas_what_it_can(raw: Path) -> None:
    findings = {it["what"]: it["value"] for it in shown("doctor", raw)["findings"]}
    assert findings["source"] == "9 panoramas, 64x32"
    assert findings["preparation"] == "masks, poses and points, check"
    assert re.match(r"roughly \d:\d\d to make the scene and [\d:]+ to train,", findings["time of the job"])
    assert "the panoramas have 64 pixels" in one_line(call("doctor", raw, "--width", 128))


def test_a_network_that_does_not_fit_is_refused_at_once(raw: Path, sfm: FakeSfm, tmp_path: Path) -> None:
    head = {"output": "distance", "kind": "inverse", "distance": "radial"}
    model = red_depth(tmp_path, {"task": "depth", "input": given(), "depth": head})
    with pytest.raises(InputError, match="it has no output distance"):
        start(raw, tmp_path / "run", depth_model=str(model))
    assert sfm.calls == []
    assert not (tmp_path / "run").exists()
