"""The command: wrong input, results of other settings or code, and the order in which variants run."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

import panolog
from benchmarks.paper import __main__ as command
from benchmarks.paper.code import present
from benchmarks.paper.results import Result, Results, save
from benchmarks.paper.runner import Bench, run_all
from benchmarks.paper.tables import main_tables
from benchmarks.paper.variants import Settings, Variant, variants
from tests.benchmarks.paper.made import result
from tests.scenes import write_scene

SETTINGS = Settings(32, 16, "2x1x1", "cpu", ("sky.count=20",))
SMALL = ["--width", "32", "--iterations", "16", "--set", "sky.count=20", "--device", "cpu"]
KNOWN = variants()


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "street")


@pytest.fixture
def bench(scene: Path, tmp_path: Path) -> Bench:
    return Bench(tmp_path / "out", scene, 0, SETTINGS)


@pytest.fixture
def stored(bench: Bench) -> Callable[..., None]:
    """Makes a result of a variant as if it had run now, but for what is given."""

    def make(name: str, **more: object) -> None:
        config = KNOWN[name].config(SETTINGS, 0, SETTINGS.iterations)
        given: dict[str, Any] = {
            "settings": config,
            "sources": bench.code.sources,
            "code": bench.code.name,
            **more,
        }
        bench.folder.mkdir(parents=True, exist_ok=True)
        save(bench.folder / f"{name}@0.json", result(name, 24.0, **given))

    return make


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{scene}", "{twin}"], "two scenes are named street"),
        (["{scene}", "--set", "sky.cuont=1"], "did you mean sky.count"),
        (["{scene}", "--tables", "main,mian"], "--tables: mian is none of main"),
        (["{scene}", "--tables", "tau", "--only", "paper,tau-0.6"], "--only: tau-0.6 is none of paper"),
        (["{scene}", "--seeds", "0"], "--seeds: at least 1"),
        (["{scene}", "--kind", "town=flat"], "--kind town=flat: give the name of a scene"),
        (["{scene}", "--kind", "street=road"], "--kind street=road: give the name of a scene"),
    ],
)
def test_wrong_input_is_exit_code_2(
    words: list[str], message: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = write_scene(tmp_path / "other" / "street")
    given = [word.format(scene=scene, twin=twin) for word in words]
    try:
        code = command.main([*given, "-o", str(tmp_path / "out"), *SMALL])
    except SystemExit as ending:
        code = int(str(ending))
    assert code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    first = Settings(64, 600, "2x1x1", "cpu", ())
    command.store_settings(tmp_path, first)
    command.store_settings(tmp_path, first)
    with pytest.raises(panolog.InputError, match="width 64, not 32"):
        command.store_settings(tmp_path, Settings(32, 600, "2x1x1", "cpu", ()))


def test_a_switch_that_needs_others_is_a_row_that_says_so(bench: Bench) -> None:
    alone = Variant("with sky.count", "", {"recipe": "paper", "sky.count": -1})
    assert "sky.count" in bench.result(alone).failed
    later = Variant("later", "", {}, lambda length, _: length, ("paper",))
    assert bench.result(later).failed == "it depends on paper, which has no result"


def test_a_result_of_other_settings_is_refused(
    bench: Bench, stored: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    paper = KNOWN["paper"]
    config = paper.config(SETTINGS, 0, 16)
    stored("paper")
    bench.check([paper, KNOWN["tau-0.7"]])
    assert bench.result(paper).metric("ws_psnr") == 24.0  # as it was stored: nothing runs
    older = {key: value for key, value in config.items() if key != "optimizer.short_runs"}
    stored("paper", settings=older)  # from before there was this setting
    bench.check([paper])
    for settings, message in (
        (config | {"densify.every": 7}, r"paper@0.json: .*densify.every = 7, not .*; take another folder"),
        ({}, "settings that are not stored"),
    ):
        stored("paper", settings=settings)
        for refused in (bench.check, lambda variants: bench.result(*variants)):
            with pytest.raises(panolog.InputError, match=message):
                refused([paper])
    given = [str(bench.scene), "-o", str(bench.folder.parent), "--tables", "tau", *SMALL]
    assert command.main(given) == 2
    assert "settings that are not stored" in capsys.readouterr().err


def test_a_result_of_stage_one_outlasts_other_settings_of_blocks(
    bench: Bench, stored: Callable[..., None]
) -> None:
    alone, blocks = KNOWN["panolog-stage1"], KNOWN["panolog"]
    for variant, outlasts in ((alone, True), (blocks, False)):
        settings = variant.config(SETTINGS, 0, 16) | {"stage2.rate": 0.5, "passes.rate": 0.5}
        stored(variant.name, settings=settings)
        with nullcontext() if outlasts else pytest.raises(panolog.InputError, match=r"stage2\.rate = 0\.5"):
            bench.check([variant])
    bench.result(alone)
    assert bench.done[alone.name].config["stage2.rate"] == 0.5  # as a run has it that borrows from this one


def test_only_some_variants_may_run_and_all_results_are_reported(
    bench: Bench, stored: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []

    def trained(self: Bench, variant: Variant) -> Result:
        ran.append(variant.name)
        return result(variant.name, 24.0)

    stored("paper")
    monkeypatch.setattr(Bench, "result", trained)
    table = [KNOWN[name] for name in ("paper", "tau-0.7", "tau-0.8")]
    for only, expected in ((None, 3), (["tau-0.8"], 2), ((), 1)):
        assert len(list(run_all([bench], [table], only))) == expected
    assert ran == ["paper", "tau-0.7", "tau-0.8", "paper", "tau-0.8", "paper"]


def test_a_result_of_other_code_says_so(
    bench: Bench, stored: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    stored("paper", sources="0123", code="abcdef")
    stored("tau-0.7")
    found = Results([bench.result(KNOWN[name]) for name in ("paper", "tau-0.7")])
    assert "paper@0.json: measured at abcdef; now it is" in capsys.readouterr().err
    (table,) = main_tables(found, ["tau"], [bench.scene])
    assert str(table.rows[0][-1]).endswith("measured at abcdef")
    assert bench.code.name in str(table.rows[1][-1])


def test_code_is_what_decides_a_training(tmp_path: Path) -> None:
    for package in ("scene", "renderer", "partition", "workers", "orchestrator/engine/driver", "prepare"):
        (tmp_path / package).mkdir(parents=True)
        (tmp_path / package / "a.py").write_text("x = 1")
    before = present(tmp_path)
    assert before.name == f"sources {before.sources}"  # no checkout
    (tmp_path / "prepare" / "a.py").write_text("x = 2")
    assert present(tmp_path) == before
    (tmp_path / "workers" / "a.py").write_text("x = 2")
    assert present(tmp_path).sources != before.sources
