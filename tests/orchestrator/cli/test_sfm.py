"""panolog scene sfm, as a user calls it; what it makes is proven in tests/prepare/sfm."""

import json
from pathlib import Path
from typing import Any

import pytest

from panolog.prepare.sfm import pipeline
from tests.orchestrator.cli.program import call, one_line
from tests.prepare.sfm.reports import faulty


def test_options_reach_the_job_and_its_report_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[Any, ...]] = []
    report = faulty()

    def make_scene(*arguments: Any, memory: int) -> object:
        assert memory > 0
        given.append(arguments[:3])
        return report

    monkeypatch.setattr(pipeline, "make_scene", make_scene)
    output = tmp_path / "scene"
    result = call("scene", "sfm", "images", "-o", output, "--json", "--partial", "--pairs", "exhaustive")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"scene": str(output), **report.as_json()}
    wanted = pipeline.SfmSettings(partial=True, parts=True, pairing="exhaustive")
    assert given == [(Path("images"), output, wanted)]
    result = call("scene", "sfm", "images", "-o", output)
    assert result.exit_code == 0
    assert result.stdout.splitlines()[: len(list(report.lines()))] == list(report.lines())


def test_what_cannot_be_done_is_one_line(tmp_path: Path) -> None:
    output = tmp_path / "scene"
    assert one_line(call("scene", "sfm", tmp_path / "nothing", "-o", output))
    assert call("scene", "sfm", tmp_path, "-o", output, "--mapper", "magic").exit_code == 2
    assert not output.exists()
