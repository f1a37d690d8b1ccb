"""The pure parts of the comparison of variants: options, table, and what a folder may be used for."""

import json
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from benchmarks.quality import VARIANTS, Bench, Result, Settings, parse, table
from benchmarks.report import markdown
from panolog.orchestrator.run.config import load_config
from panolog.scene.errors import InputError, RunError
from tests.scenes import write_scene

SETTINGS = Settings("scene", 128, 30, "2x1x1", ("sky.count=2000",), None)
RESULT = Result(
    "full", 21.25, 0.7, 22.5, None, 12345, 3_000_000, 30, 2, 10.2, 3.1, 20.3, 40.6, 2, ("one", "two")
)


@pytest.fixture
def scene(tmp_path: Path) -> str:
    return str(write_scene(tmp_path / "scene"))


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_is_a_valid_run_and_overrides_the_user(variant: str) -> None:
    options = SETTINGS.options(variant, 30)
    sets = [value for option, value in pairwise(options) if option == "--set"]
    config = load_config(None, sets).model_dump()
    for key, value in VARIANTS[variant].items():
        found: Any = config
        for part in key.split("."):
            found = found[part]
        assert found == value
    assert config["sky"]["count"] == (0 if variant == "no-sky" else 2000)


def test_stage_one_alone_trains_as_long_as_all_stages_together(tmp_path: Path, scene: str) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "full.json").write_text(json.dumps(asdict(RESULT)))
    bench = Bench(tmp_path / "out", Settings(scene, 32, 30, "2x1x1", (), None))
    full = bench.result("full")
    assert full == RESULT  # known: not run again
    assert bench._iterations("coarse-only", RESULT) == 90
    assert bench._iterations("no-sky", RESULT) == 30
    with pytest.raises(RunError, match="--coarse-iterations"):
        bench._iterations("coarse-only", None)


def test_a_scene_without_depth_skips_that_variant(tmp_path: Path, scene: str) -> None:
    bench = Bench(tmp_path / "out", Settings(scene, 32, 30, "2x1x1", (), None))
    reason = bench.result("no-depth")
    assert reason == "skipped: the scene has no depth images"
    assert "| no-depth | –" in table({"no-depth": reason})


def test_a_folder_of_other_settings_is_refused(tmp_path: Path, scene: str) -> None:
    Bench(tmp_path / "out", Settings(scene, 32, 30, "2x1x1", (), None))
    Bench(tmp_path / "out", Settings(scene, 32, 30, "2x1x1", (), None))
    with pytest.raises(InputError, match="iterations 30, not 40"):
        Bench(tmp_path / "out", Settings(scene, 32, 40, "2x1x1", (), None))


def test_the_table_says_how_long_each_trained() -> None:
    row = table({"full": RESULT}).splitlines()[2]
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    assert cells[:6] == ["full", "21.25", "0.7000", "22.50", "–", "12,345"]
    assert cells[7:9] == ["30 + 2 × 30", "10"]
    assert cells[-1] == "one; two"


def test_unknown_variants_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert parse(["scene", "-o", "out", "--variants", "no-sky,full"]).variants == ["full", "no-sky"]
    with pytest.raises(SystemExit):
        parse(["scene", "-o", "out", "--variants", "full,no-skye"])
    assert "no-skye is none of" in capsys.readouterr().err


def test_markdown_keeps_columns_aligned() -> None:
    lines = markdown(["a", "b"], [[1234, 0.5], [None, 12345.6]]).splitlines()
    assert lines == [
        "| a     | b      |",
        "|-------|--------|",
        "| 1,234 | 0.5000 |",
        "| –     | 12,346 |",
    ]
