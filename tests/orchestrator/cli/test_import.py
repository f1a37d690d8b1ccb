"""`panolog scene import` and `panolog scene check` from the command line."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from panolog.orchestrator.cli import app
from tests.orchestrator.messages import without_progress
from tests.prepare.importers.writers import nerfstudio, opensfm


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app.app, [str(argument) for argument in arguments])


def test_import(tmp_path: Path) -> None:
    _, source = opensfm(tmp_path / "source")
    result = call("scene", "import", source.path, "-o", tmp_path / "scene")
    assert result.exit_code == 0, result.output
    assert "6 panoramas, 40 points" in result.stdout
    assert "smaller reconstructions are left out" in result.stderr
    assert call("scene", "info", tmp_path / "scene").exit_code == 0


def test_import_as_json(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    arguments = ("-o", tmp_path / "scene", "--link", "--json", "--format", "nerfstudio")
    result = call("scene", "import", source.path / "transforms.json", *arguments)
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert (report["format"], report["panoramas"], report["points"]) == ("nerfstudio", 6, 40)
    assert (tmp_path / "scene" / "images" / "pano_00.png").is_symlink()


@pytest.mark.parametrize("option", [(), ("--format", "colmapper"), ("--images", "nowhere")])
def test_wrong_imports_are_one_line(option: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    result = call("scene", "import", tmp_path / "empty", "-o", tmp_path / "scene", *option)
    assert result.exit_code == 2
    assert len(without_progress(result.stderr)) == 1
    assert result.stdout == ""
    assert not (tmp_path / "scene").exists()


def test_check_of_pictures_that_show_nothing(tmp_path: Path) -> None:
    """The pictures of the small scene are noise: said in one line, and by the exit code."""
    _, source = nerfstudio(tmp_path / "source")
    assert call("scene", "import", source.path, "-o", tmp_path / "scene").exit_code == 0
    result = call("scene", "check", tmp_path / "scene")
    assert result.exit_code == 2
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("WRONG")]
    assert "points and pixels hardly correlate" in line
    found = call("scene", "check", tmp_path / "scene", "--json")
    assert found.exit_code == 2
    assert len(json.loads(found.stdout)["problems"]) == 1
    assert call("scene", "check", tmp_path / "nowhere").exit_code == 2
