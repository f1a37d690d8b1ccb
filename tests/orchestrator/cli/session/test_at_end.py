"""What follows a run: files for viewers, and the command of `--at-end`."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.cli.session import at_end, supervise
from panolog.orchestrator.cli.session.at_end import when_ended
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.info import SceneRef, make_info, write_info
from panolog.orchestrator.runs.money.records import BudgetReached, BudgetSet
from panolog.orchestrator.runs.records import Delivered, Noticed, Outcome, Record, RunBegan, RunEnded
from panolog.orchestrator.runs.storage.state import MirrorState, write_state
from panolog.scene.ply import read_ply, read_sky
from panolog.workers.tasks import DELIVER, EVAL
from tests.orchestrator.cli.program import call
from tests.orchestrator.fakes import Harness
from tests.orchestrator.history import begun

URL = "s3://bucket/run"
BEGAN = RunBegan("host", 7, resumed=False)
DONE = (BEGAN, RunEnded(Outcome.DONE))
LIMITED = (BEGAN, BudgetSet(deadline=5.0), BudgetReached("the limit of 5 USD"), RunEnded(Outcome.LIMITED))
FAILED = (BEGAN, RunEnded(Outcome.FAILED, "block 3 has failed"))


class End:
    """A command that leaves what its environment has."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "said"
        words = "$PANOLOG_OUTCOME|$PANOLOG_REASON|$PANOLOG_RUN"
        self.option = ("--at-end", f'echo "{words}" >> {self._file}')

    @property
    def said(self) -> list[list[str]]:
        """Outcome, reason and run of each time."""
        lines = self._file.read_text().splitlines() if self._file.exists() else []
        return [line.split("|") for line in lines]


@pytest.fixture
def end(tmp_path: Path) -> End:
    return End(tmp_path)


def drive(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Lets a supervisor run drivers that are these lines of Python."""
    monkeypatch.setattr(supervise, "_PROGRAM", (sys.executable, "-c", program))


@pytest.mark.parametrize(("records", "outcome"), [(DONE, "done|"), (LIMITED, "limited|the limit of 5 USD")])
def test_it_follows_the_end_of_a_run(
    tmp_path: Path, end: End, records: tuple[Record, ...], outcome: str
) -> None:
    folder = begun(tmp_path / "run", *records)
    result = call("resume", folder.root, *end.option)
    assert result.exit_code == 0, result.output
    assert end.said == [[*outcome.split("|"), str(folder.root)]]
    assert "carrying out --at-end: echo" in result.stderr


def test_a_run_that_fails_or_is_refused_is_told_apart(tmp_path: Path, end: End) -> None:
    """The scene is gone, so neither can be resumed."""
    for name, records, outcome in (("a", FAILED, "failed"), ("b", (BEGAN,), "refused")):
        folder = begun(tmp_path / name, *records)
        assert call("resume", folder.root, *end.option).exit_code == 2
        (found, reason, run) = end.said[-1]
        assert (found, run) == (outcome, str(folder.root)) and "/gone" in reason


def test_a_run_that_is_refused_before_there_is_a_folder(tmp_path: Path, end: End) -> None:
    root = tmp_path / "new"
    assert call("run", tmp_path / "nowhere", "-o", root, *end.option).exit_code == 2
    ((outcome, reason, run),) = end.said
    assert (outcome, run) == ("refused", str(root)) and "nowhere" in reason and not root.exists()


def test_a_supervisor_carries_it_out_once_when_it_gives_up(
    tmp_path: Path, end: End, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = begun(tmp_path / "run", BEGAN)
    monkeypatch.setattr(supervise, "_FIRST_S", 0.0)
    drive(monkeypatch, "import os; os.kill(os.getpid(), 9)")
    assert call("resume", folder.root, "--supervise", "--max-resumes", 2, *end.option).exit_code == 1
    assert end.said == [["failed", "exit code 1", str(folder.root)]]


@pytest.mark.parametrize(
    ("code", "said"), [(0, ["done"]), (1, ["failed"]), (2, ["refused"]), (130, [])], ids=str
)
def test_a_supervisor_carries_it_out_unless_its_driver_was_stopped(
    tmp_path: Path, end: End, monkeypatch: pytest.MonkeyPatch, code: int, said: list[str]
) -> None:
    folder = begun(tmp_path / "run", BEGAN)
    drive(monkeypatch, f"import sys; sys.exit({code})")
    assert call("resume", folder.root, "--supervise", *end.option).exit_code == code
    assert [outcome for outcome, *_ in end.said] == said


def test_another_driver_keeps_its_machine(tmp_path: Path, end: End) -> None:
    folder = begun(tmp_path / "run", BEGAN)
    with lock.hold(folder.lock):
        result = call("resume", folder.root, *end.option)
    assert result.exit_code == 2 and end.said == []
    assert "another driver is at work" in result.stderr


def test_a_run_that_is_not_all_in_its_store_keeps_its_machine(tmp_path: Path, end: End) -> None:
    folder = begun(tmp_path / "run", *DONE)
    said: list[str] = []
    for state, count in ((MirrorState(URL, problem="no access"), 0), (MirrorState(URL, complete=True), 1)):
        write_state(folder.mirror, state)
        with when_ended(end.option[1], said.append) as own:
            own(folder.root)
        assert len(end.said) == count
    assert said[0].endswith(f"for nothing to be lost: nothing is in {URL} yet; no access")


def test_a_command_that_fails_or_hangs_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, file = begun(tmp_path / "run", *DONE), tmp_path / "continues"
    result = call("resume", folder.root, "--at-end", "exit 3")
    assert (result.exit_code, "has failed (code 3)" in result.stderr) == (0, True)
    started: list[subprocess.Popen[bytes]] = []

    def start(*words: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(subprocess.Popen(*words, **options))
        return started[-1]

    monkeypatch.setattr(at_end, "Popen", start)
    monkeypatch.setattr(at_end, "_LONGEST_S", 0.05)
    waits = f"while [ ! -e '{file}' ]; do sleep 0.02; done; exit 7"
    result = call("resume", folder.root, "--at-end", waits)
    assert "it continues by itself" in result.stderr
    file.touch()
    assert started[0].wait(timeout=300) == 7


def delivering(folder: Path) -> Harness:
    """A run with run.json, which names the scene."""
    harness = Harness(folder, deliver=True)
    scene = harness.job.scene
    reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
    write_info(harness.folder, make_info(reference, harness.job.config))
    return harness


def test_files_for_viewers(tmp_path: Path) -> None:
    harness = delivering(tmp_path)
    state = harness.drive()
    assert state.outcome == "done"
    folder, (record,) = harness.folder, harness.records(Delivered)
    whole = read_ply(folder.point_cloud)
    sky = read_ply(folder.sky)
    assert (len(sky), sky.sky) == (whole.sky, whole.sky)
    assert (sky.means == read_sky(folder.point_cloud).means).all()
    place = json.loads(folder.georeference.read_bytes())
    assert place["provenance"]["scene"] == harness.job.scene.fingerprint
    assert place["provenance"]["settings"]["width"] == harness.job.config.width
    page = json.loads((folder.web / "scene.json").read_bytes())
    assert page["total"] == len(whole)
    assert [camera["name"] for camera in page["cameras"]]
    assert (folder.web / page["model"]).is_file() and (folder.web / "index.html").is_file()
    files = [folder.sky, folder.georeference, folder.page, *folder.web.rglob("*")]
    assert b"engine.js" in folder.page.read_bytes()
    assert record.size == sum(file.stat().st_size for file in files if file.is_file())
    assert state.task(DELIVER).status == "done"


def test_a_resumed_run_has_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    whole, killed = delivering(tmp_path / "a"), delivering(tmp_path / "b")
    whole.drive()

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("panolog.orchestrator.cli.session.delivery.write_json", die)
        with pytest.raises(KeyboardInterrupt):
            killed.drive()
    assert killed.state.task(EVAL).status == "done" != killed.state.task(DELIVER).status
    assert killed.drive(resumed=True).outcome == "done"
    for name in ("web/scene.json", "web/model.sog", "sky.ply"):
        assert (whole.folder.root / name).read_bytes() == (killed.folder.root / name).read_bytes()


def test_a_place_that_is_wrong_is_a_notice(tmp_path: Path) -> None:
    harness = delivering(tmp_path)
    (harness.job.scene.root / "offset.json").write_text("{}")
    assert harness.drive().outcome == "done"
    (notice,) = (record for record in harness.records(Noticed) if record.task == DELIVER)
    assert "no files for viewers" in notice.message and "offset.json: offset" in notice.message
    assert not harness.folder.web.exists()
