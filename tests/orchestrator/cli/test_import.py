"""`panolog scene import` and `panolog scene check` from the command line."""

import json
from pathlib import Path

import pytest

from tests.orchestrator.cli.program import call, one_line, shown
from tests.prepare.importers.writers import nerfstudio, opensfm


def test_import(tmp_path: Path) -> None:
    _, source = opensfm(tmp_path / "source")
    result = call("scene", "import", source.path, "-o", tmp_path / "scene")
    assert result.exit_code == 0, result.output
    assert "6 panoramas, 40 points" in result.stdout
    assert "smaller reconstructions are left out" in result.stderr
    assert call("scene", "info", tmp_path / "scene").exit_code == 0


def test_import_as_json(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    arguments = ("-o", tmp_path / "scene", "--link", "--format", "nerfstudio")
    report = shown("scene", "import", source.path / "transforms.json", *arguments)
    assert (report["format"], report["panoramas"], report["points"]) == ("nerfstudio", 6, 40)
    assert (tmp_path / "scene" / "images" / "pano_00.png").is_symlink()
    # The pictures of the small scene are noise: said in one line, and by the exit code.
    result = call("scene", "check", tmp_path / "scene")
    assert result.exit_code == 2
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("WRONG")]
    assert "points and pixels hardly correlate" in line
    assert result.stdout.splitlines()[-1] == "verdict: a problem; fix that first, or training yields fog"
    found = call("scene", "check", tmp_path / "scene", "--json")
    assert found.exit_code == 2
    assert len(json.loads(found.stdout)["problems"]) == 1


@pytest.mark.parametrize("option", [(), ("--format", "colmapper"), ("--images", "nowhere")])
def test_wrong_imports_are_one_line(option: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert one_line(call("scene", "import", tmp_path / "empty", "-o", tmp_path / "scene", *option))
    assert not (tmp_path / "scene").exists()
    assert call("scene", "check", tmp_path / "scene").exit_code == 2
