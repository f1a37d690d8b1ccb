import json
import os
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from panolog.orchestrator.runs import info, lock
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder, model_of, shown_model
from panolog.orchestrator.runs.info import SceneRef, check_output, make_info, read_info, write_info
from panolog.scene.errors import InputError
from panolog.workers.tasks import COARSE, TaskId

SCENE = SceneRef(path="/scene", fingerprint="f")


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "run")
    folder.root.mkdir()
    write_info(folder, make_info(SCENE, RunConfig(width=64, seed=3)))
    return folder


def test_run_json_holds_the_resolved_settings(folder: RunFolder) -> None:
    found = read_info(folder)
    assert (found.scene, found.config, found.seed) == (SCENE, RunConfig(width=64, seed=3), 3)
    assert {"panolog", "python", "torch", "ray"} <= set(found.versions)
    assert json.loads(folder.info.read_text())["config"]["sky"]["count"] == 100_000


def test_no_second_folder_of_a_run_is_made(folder: RunFolder) -> None:
    folder.make(folder.seam(0, 1))
    assert folder.seam(0, 1).is_dir()
    folder.root.rename(folder.root.with_name("away"))
    with pytest.raises(FileNotFoundError):
        folder.make(folder.seam(0, 1))
    assert not folder.root.exists()


def test_a_3d_view_shows_the_latest_snapshot_while_stage_one_trains(folder: RunFolder) -> None:
    snapshot, last, block = folder.snapshot(COARSE), folder.checkpoint(COARSE), TaskId.block(0)
    snapshot.parent.mkdir()

    def written(path: Path, time: int) -> None:
        path.touch()
        os.utime(path, (time, time))

    with pytest.raises(InputError, match="no model yet"):
        shown_model(folder)
    written(snapshot, 10)
    assert shown_model(folder) == shown_model(folder, COARSE) == snapshot
    with pytest.raises(InputError, match="block/000 has no model yet"):
        shown_model(folder, block)
    written(last, 20)
    with lock.hold(folder.lock):
        assert shown_model(folder) == snapshot and model_of(folder) == last  # what is exported is whole
    assert shown_model(folder) == last
    written(snapshot, 30)
    assert shown_model(folder) == snapshot  # the driver was killed after it
    for path in (folder.model(COARSE), folder.point_cloud):
        written(path, 5)
        assert shown_model(folder) == path


def test_a_run_needs_no_version_of_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a pool of local processes it works without."""

    def version(name: str) -> str:
        if name == "ray":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(info, "version", version)
    versions = make_info(SCENE, RunConfig()).versions
    assert versions["torch"] == "1.0" and "ray" not in versions


def test_a_new_or_empty_folder_will_do(tmp_path: Path) -> None:
    check_output(tmp_path / "a" / "b", "f")
    check_output(tmp_path, "f")
    assert not (tmp_path / "a").exists()
    (tmp_path / "lock").touch()  # a driver was killed before run.json
    check_output(tmp_path, "f")


def test_an_occupied_folder_is_refused_and_untouched(folder: RunFolder, tmp_path: Path) -> None:
    before = folder.info.read_bytes()
    with pytest.raises(InputError, match="use `panolog resume"):
        check_output(folder.root, "f")
    with pytest.raises(InputError, match="another scene"):
        check_output(folder.root, "g")
    assert folder.info.read_bytes() == before
    (tmp_path / "other").mkdir()
    for foreign in ("thesis.txt", "run.db"):
        (tmp_path / "other" / foreign).touch()
        with pytest.raises(InputError, match="not empty"):
            check_output(tmp_path / "other", "f")
        (tmp_path / "other" / foreign).unlink()
    with pytest.raises(InputError, match="is a file"):
        check_output(folder.info, "f")


def test_an_unwritable_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be written, because .*file is not a folder"):
        check_output(tmp_path / "file" / "run", "f")
    monkeypatch.setattr(os, "access", lambda *_: False)  # as for users other than root
    with pytest.raises(InputError, match="cannot be written"):
        check_output(tmp_path / "run", "f")


@pytest.mark.parametrize("content", ["{", '{"format": 2}', "[]"])
def test_a_damaged_run_json_is_one_clear_line(folder: RunFolder, content: str) -> None:
    folder.info.write_text(content)
    with pytest.raises(InputError) as caught:
        read_info(folder)
    assert "\n" not in str(caught.value)


def test_only_plain_files_of_the_run_are_read_and_up_to_a_size(folder: RunFolder, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    link, whole = folder.root / "link", folder.info.read_bytes()
    link.symlink_to(tmp_path / "secret")
    os.mkfifo(folder.root / "pipe")
    assert folder.read(folder.info, len(whole)) == whole
    for path, most, why in (
        (folder.root / "none", 9, "none: cannot be read: No such file or directory"),
        (folder.root / "zero\0byte", 9, "cannot be read: embedded null byte"),
        (link, 9, "link: is not a plain file of the run"),
        (folder.root / "pipe", 9, "pipe: is not a plain file of the run"),
        (folder.root, 9, "run: is not a plain file of the run"),
        (folder.info, len(whole) - 1, "run.json: has more than"),
    ):
        with pytest.raises(InputError, match=why):
            folder.read(path, most)


def test_only_one_holds_the_lock_and_looking_does_not_take_it(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    assert not lock.held(path)
    with lock.hold(path):
        assert lock.held(path)
        with pytest.raises(InputError, match="another driver"), lock.hold(path):
            pass
        assert lock.held(path)
    assert not lock.held(path)
    with lock.hold(path):
        pass
