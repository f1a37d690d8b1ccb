"""The command: wrong input, and a whole small study that is resumed."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import panolog
from benchmarks import runs
from benchmarks.paper import __main__ as command
from benchmarks.paper.results import from_json
from benchmarks.paper.runner import Bench, Clock
from benchmarks.paper.variants import Settings, Variant
from panolog.orchestrator.commands.evaluate import evaluate_run
from panolog.orchestrator.driver.local_pool import LocalPool, local_pool
from panolog.orchestrator.run.config import load_config
from tests.scenes import write_scene

SMALL = ["--width", "32", "--iterations", "16", "--set", "sky.count=20", "--device", "cpu"]


@pytest.fixture
def scene(tmp_path: Path) -> str:
    return str(write_scene(tmp_path / "street"))


def test_wrong_input_is_exit_code_2(scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "out")
    twin = str(write_scene(tmp_path / "other" / "street"))
    for words, message in (
        ([str(tmp_path / "none")], "none"),
        ([scene, twin], "two scenes are named street"),
        ([scene, "--opensplat", "/nothing"], "there is no such file"),
        ([scene, "--set", "sky.cuont=1"], "did you mean sky.count"),
        ([scene, "--docs", "a.md", "--also", str(tmp_path)], "holds no results"),
    ):
        assert command.main([*words, "-o", folder, *SMALL]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
    for arguments in (["--tables", "main,mian"], ["--seeds", "0"], ["--also", "folder"]):
        with pytest.raises(SystemExit) as caught:
            command.parse([scene, "-o", folder, *arguments])
        assert caught.value.code == 2


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    first = Settings(64, 600, "2x1x1", "cpu", ())
    command.store_settings(tmp_path, first)
    command.store_settings(tmp_path, first)
    with pytest.raises(panolog.InputError, match="width 64, not 32"):
        command.store_settings(tmp_path, Settings(32, 600, "2x1x1", "cpu", ()))


def test_the_time_left_is_that_of_what_has_run() -> None:
    timer = Clock()
    assert timer.left(10) == "time left not known yet"
    timer.took(60, 10)
    assert timer.left(100) == "about 10 min left"
    assert timer.left(1) == "less than a minute left"


def test_a_switch_that_needs_others_is_a_row_that_says_so(scene: str, tmp_path: Path) -> None:
    bench = Bench(tmp_path, Path(scene), 0, Settings(32, 16, "2x1x1", "cpu", ()))
    alone = Variant("with sky.count", "", {"recipe": "paper", "sky.count": -1})
    assert "sky.count" in bench.result(alone).failed
    later = Variant("later", "", {}, lambda length, _: length, ("paper",))
    assert bench.result(later).failed == "it depends on paper, which has no result"


@pytest.fixture
def pool() -> Iterator[LocalPool]:
    with local_pool() as pool:
        yield pool


@pytest.mark.system
def test_a_study_runs_what_is_missing(
    scene: str, tmp_path: Path, pool: LocalPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def program(*words: str) -> str:
        """`panolog` in this process, without Ray."""
        calls.append(" ".join(words[:1]))
        match words:
            case ("run", place, "-o", root, *sets):
                panolog.run(place, root, load_config(None, sets[1::2]), pool=pool)
            case ("resume", root):
                panolog.resume(root, pool=pool)
            case ("eval", root, "--json"):
                none = {"model": None, "crop_bottom": None, "device": "cpu"}
                return json.dumps(evaluate_run(Path(root), **none, progress=lambda *_: None))  # type: ignore[arg-type]
        return ""

    monkeypatch.setattr(runs, "panolog", program)
    out = tmp_path / "out"
    words = [scene, "-o", str(out), "--tables", "ablations,tau", *SMALL]
    assert command.main([*words, "--docs", str(tmp_path / "quality.md")]) == 0
    found = {r["variant"]: from_json(r) for r in json.loads((out / "results.json").read_text())["results"]}
    assert list(found) == ["paper", "no-g2ps", "no-sky", "no-depth", "tau-0.7", "tau-0.8", "tau-0.9"]
    assert found["tau-0.8"].same_as == "paper"
    paper, position = found["paper"], found["no-g2ps"]
    assert position.same_as == "paper" or position.seconds["coarse"] == paper.seconds["coarse"]
    assert [point.stage for point in paper.curve][-1] == "merged"
    seconds = [point.seconds for point in paper.curve]
    assert seconds == sorted(seconds)
    assert {point.stage for point in paper.curve} == {"coarse", "block", "merged"}
    assert found["no-sky"].gaussians < paper.gaussians
    assert calls.count("run") == 3  # paper, no-sky and no-depth: the others have Stage I of paper
    assert "Written by" in (tmp_path / "quality.md").read_text()
    before = len(calls)
    assert command.main(words) == 0
    assert len(calls) == before  # nothing runs again
    assert not list((out / "street").glob("*.states"))
