"""The command: wrong input, and a whole small study that is resumed."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import panolog
from benchmarks import runs
from benchmarks.paper import __main__ as command
from benchmarks.paper.code import Code, present
from benchmarks.paper.results import Result, Results, from_json, save
from benchmarks.paper.runner import Bench, Done, run_all
from benchmarks.paper.tables import main_tables
from benchmarks.paper.variants import Settings, Variant, stages, variants
from panolog.orchestrator.driver.local_pool import local_pool
from panolog.orchestrator.resources.pool import Pool
from panolog.orchestrator.run.records import ModelSaved, TaskStarted
from panolog.workers.tasks import Stage
from tests.benchmarks.paper.made import result
from tests.scenes import write_scene

SETTINGS = Settings(32, 16, "2x1x1", "cpu", ("sky.count=20",))
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
    wrong = (["--tables", "main,mian"], ["--seeds", "0"], ["--also", "folder"], ["--kind", "street=road"])
    for arguments in (*wrong, ["--kind", "town=flat"]):
        with pytest.raises(SystemExit) as caught:
            command.parse([scene, "-o", folder, *arguments])
        assert caught.value.code == 2


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    first = Settings(64, 600, "2x1x1", "cpu", ())
    command.store_settings(tmp_path, first)
    command.store_settings(tmp_path, first)
    with pytest.raises(panolog.InputError, match="width 64, not 32"):
        command.store_settings(tmp_path, Settings(32, 600, "2x1x1", "cpu", ()))


def test_a_switch_that_needs_others_is_a_row_that_says_so(scene: str, tmp_path: Path) -> None:
    bench = Bench(tmp_path, Path(scene), 0, SETTINGS)
    alone = Variant("with sky.count", "", {"recipe": "paper", "sky.count": -1})
    assert "sky.count" in bench.result(alone).failed
    later = Variant("later", "", {}, lambda length, _: length, ("paper",))
    assert bench.result(later).failed == "it depends on paper, which has no result"


def stored(bench: Bench, variant: Variant, **more: object) -> Path:
    """Makes a result as if the variant had run now, but for `more`."""
    config = variant.config(bench.settings, 0, bench.settings.iterations)
    given: dict[str, Any] = {
        "settings": config,
        "sources": bench.code.sources,
        "code": bench.code.name,
        **more,
    }
    path = bench._file(variant)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(path, result(variant.name, 24.0, **given))
    return path


def test_a_result_of_other_settings_is_refused(
    scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path / "out", Path(scene), 0, SETTINGS)
    paper, tau = variants()["paper"], variants()["tau-0.7"]
    stored(bench, paper)
    monkeypatch.setattr(runs, "panolog", lambda *_: pytest.fail("nothing may run"))
    bench.check([paper, tau])
    assert bench.result(paper).metric("ws_psnr") == 24.0
    config = paper.config(bench.settings, 0, 16)
    older = {key: value for key, value in config.items() if key != "optimizer.short_runs"}
    stored(bench, paper, settings=older)  # from before there was this setting
    bench.check([paper])
    stored(bench, paper, settings=config | {"densify.every": 7})
    line = r"out/street/paper@0.json: .*paper has densify.every = 7, not .*; take another folder"
    with pytest.raises(panolog.InputError, match=line):
        bench.check([paper])
    with pytest.raises(panolog.InputError, match=line):
        bench.result(paper)
    assert command.main([scene, "-o", str(tmp_path / "out"), "--tables", "tau", *SMALL]) == 2
    assert "densify.every = 7" in capsys.readouterr().err
    stored(bench, paper, settings={})
    with pytest.raises(panolog.InputError, match="settings that are not stored"):
        bench.check([paper])


def test_a_result_of_other_code_says_so(
    scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(tmp_path / "out", Path(scene), 0, SETTINGS)
    known = variants()
    stored(bench, known["paper"], sources="0123", code="abcdef")
    stored(bench, known["tau-0.7"])
    found = Results([bench.result(known[name]) for name in ("paper", "tau-0.7")])
    assert "paper@0.json: measured at abcdef; now it is" in capsys.readouterr().err
    (table,) = main_tables(found, ["tau"], [Path(scene)])
    assert str(table.rows[0][-1]).endswith("measured at abcdef")
    assert bench.code.name in str(table.rows[1][-1])


def test_an_unfinished_run_of_other_settings_begins_anew(scene: str, tmp_path: Path) -> None:
    bench = Bench(tmp_path, Path(scene), 0, SETTINGS)
    names = ("tau-0.7", "tau-0.8")
    for number, name in enumerate(names):
        bench._begin(variants()[name], {"a": number})
        (bench._root(variants()[name])).mkdir()
    bench._begin(variants()[names[0]], {"a": 0})
    bench._begin(variants()[names[1]], {"a": 2})
    assert [bench._root(variants()[name]).exists() for name in names] == [True, False]
    other = Bench(tmp_path, Path(scene), 0, bench.settings, Code("0123", "abcdef"))
    other._begin(variants()[names[0]], {"a": 0})
    assert not bench._root(variants()[names[0]]).exists()


def test_code_is_what_decides_a_training(tmp_path: Path) -> None:
    for package in ("scene", "renderer", "partition", "workers", "orchestrator/driver", "prepare"):
        (tmp_path / package).mkdir(parents=True)
        (tmp_path / package / "a.py").write_text("x = 1")
    before = present(tmp_path)
    assert before.name == f"sources {before.sources}"  # no checkout
    (tmp_path / "prepare" / "a.py").write_text("x = 2")
    assert present(tmp_path) == before
    (tmp_path / "workers" / "a.py").write_text("x = 2")
    assert present(tmp_path).sources != before.sources
    assert present().sources


class Recorded(Bench):
    """One that runs nothing."""

    def known(self, variant: Variant) -> bool:
        return variant.name == "tau-0.7"

    def result(self, variant: Variant) -> Result:
        return result(variant.name, 24.0, scene=self.scene.name, seed=self.seed)


def test_what_matters_most_runs_first(tmp_path: Path) -> None:
    benches = [Recorded(tmp_path, Path(name), seed, SETTINGS) for name in "ab" for seed in (0, 1)]
    found = [(r.seed, r.variant, r.scene) for r in run_all(benches, stages(["tau", "main"]))]
    main, tau = ("paper", "panolog", "panolog-time"), ("tau-0.7", "tau-0.8", "tau-0.9")
    tables = [(0, variant, scene) for table in (main, tau) for scene in "ab" for variant in table]
    assert found == tables + [(1, variant, scene) for scene in "ab" for variant in ("paper", "panolog")]
    only = [r.variant for r in run_all(benches, stages(["tau", "main"]), finished=True)]
    assert only == ["tau-0.7", "tau-0.7"]


def test_a_run_that_misses_its_time_says_so(tmp_path: Path) -> None:
    bench = Bench(tmp_path, tmp_path / "street", 0, SETTINGS)
    bench.done = {"paper": Done({}, result("paper", 24.0), tmp_path)}  # 100 s
    timed = variants()["panolog-time"]
    missed = result(timed.name, 25.0, seconds={"coarse": 93.0})
    assert list(bench._off(timed, missed)) == ["took 93 % of the seconds it was given"]
    assert not list(bench._off(timed, result(timed.name, 25.0, seconds={"coarse": 96.0})))


@pytest.mark.nightly
def test_a_study_runs_what_is_missing(scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    @contextmanager
    def alone(root: Path) -> Iterator[Pool]:
        """Without Ray."""
        calls.append(root.name)
        with local_pool() as pool:
            yield runs.OneAtATime(pool)

    monkeypatch.setattr(runs, "one_at_a_time", alone)
    out = tmp_path / "out"
    words = [scene, "-o", str(out), "--tables", "ablations,tau", *SMALL]
    assert command.main([*words, "--docs", str(tmp_path / "quality.md")]) == 0
    found = {r["variant"]: from_json(r) for r in json.loads((out / "results.json").read_text())["results"]}
    assert list(found) == ["paper", "no-g2ps", "no-sky", "no-depth", "tau-0.7", "tau-0.8", "tau-0.9"]
    assert found["tau-0.8"].same_as == "paper"
    paper = found["paper"]
    seconds = [point.seconds for point in paper.curve]
    assert seconds == sorted(seconds)
    assert {point.stage for point in paper.curve} == {"coarse", "block", "merged"}
    assert found["no-sky"].gaussians < paper.gaussians
    shared = [name for name, result in found.items() if "Stage I of paper" in result.notes]
    assert len(calls) == 3 + len(shared)  # paper, no-sky and no-depth: the others have Stage I of paper
    records = [item.record for item in runs.history(out / "street" / "paper@0")]
    order = [
        (type(record), record.task.number)
        for record in records
        if isinstance(record, TaskStarted | ModelSaved) and record.task.stage is Stage.BLOCK
    ]
    assert sorted(order[0::2], key=lambda one: one[1]) == [(TaskStarted, 0), (TaskStarted, 1)]
    assert order[1::2] == [(ModelSaved, number) for _, number in order[0::2]]  # one after another
    before = len(calls)
    assert command.main(words) == 0
    assert len(calls) == before  # nothing runs again
    assert not list((out / "street").glob("*.states"))
